"""Textures of the scenes, all drawn: sRGB bytes (height, width, 3), fine enough that a blurred refraction shows."""

from collections.abc import Sequence

import numpy as np

from catacaustics.shapes import UInt8

Image = UInt8[np.ndarray, "_ _ 3"]

INK, CREAM, RED, TEAL, OCHRE, NAVY, LEAF = (
    (38, 40, 48),
    (240, 232, 214),
    (196, 68, 54),
    (46, 132, 136),
    (222, 164, 58),
    (52, 72, 124),
    (92, 138, 78),
)
PALETTE = (CREAM, RED, TEAL, OCHRE, NAVY, LEAF, INK)


def plain(colour: Sequence[int] = (255, 255, 255)) -> Image:
    """One texel."""
    return np.array(colour, np.uint8)[None, None].copy()


def checkerboard(columns: int, rows: int, texels: int, light: Sequence[int], dark: Sequence[int]) -> Image:
    """Squares of `texels` texels."""
    odd = np.add.outer(np.arange(rows), np.arange(columns)) % 2
    board = np.array([light, dark], np.uint8)[odd]
    return np.repeat(np.repeat(board, texels, 0), texels, 1)


def tiles(columns: int, rows: int, texels: int, seed: int, palette: Sequence[Sequence[int]] = PALETTE) -> Image:
    """Painted tiles: on each a disk, diamond, quarter rings, a cross or stripes in two colours of the palette."""
    import cv2

    rng = np.random.default_rng(seed)
    fine = 4 * texels
    v, u = np.meshgrid(*[(np.arange(fine) + 0.5) / fine - 0.5] * 2, indexing="ij")
    corner = np.hypot(np.abs(u) - 0.5, np.abs(v) - 0.5)
    motifs = [
        np.hypot(u, v) < 0.34,
        np.abs(u) + np.abs(v) < 0.42,
        np.abs(np.hypot(u + 0.5, v + 0.5) - 0.5) < 0.16,
        (np.abs(u) < 0.13) | (np.abs(v) < 0.13),
        ((u + v) * 3 % 1) < 0.5,
        corner < 0.36,
        (np.hypot(u, v) < 0.42) & (np.hypot(u, v) > 0.22),
    ]
    grout = np.maximum(np.abs(u), np.abs(v)) > 0.465
    picture = np.empty((rows * texels, columns * texels, 3), np.uint8)
    for i in range(rows):
        for j in range(columns):
            ground, figure = (np.array(palette[k], float) for k in rng.choice(len(palette), 2, replace=False))
            shape = np.rot90(motifs[rng.integers(len(motifs))], int(rng.integers(4)))
            tile = np.where(shape[..., None], figure, ground)
            tile = np.where(grout[..., None], (206, 200, 188), tile)
            tile = cv2.resize(tile, (texels, texels), interpolation=cv2.INTER_AREA)
            picture[i * texels : (i + 1) * texels, j * texels : (j + 1) * texels] = np.round(tile)
    return picture


def planks(columns: int, rows: int, texels: int, seed: int) -> Image:
    """Wooden boards of different shades, with grain along them."""
    import cv2

    rng = np.random.default_rng(seed)
    height, width = rows * texels, columns * texels
    grain = cv2.resize(rng.normal(size=(height, max(width // 48, 2))), (width, height), interpolation=cv2.INTER_CUBIC)
    shade = np.repeat(rng.uniform(0.72, 1.08, rows), texels)[:, None] + 0.05 * grain
    joint = (np.arange(height) % texels < max(texels // 12, 1))[:, None]
    for i in range(rows):  # boards end in different places
        end = int(rng.integers(width))
        row = slice(i * texels, (i + 1) * texels)
        shade[row, end:] *= rng.uniform(0.8, 1.15)
        shade[row, end : end + max(texels // 12, 1)] *= 0.5
    shade = np.where(joint, 0.55 * shade, shade)
    return np.clip(np.array([186, 138, 92]) * shade[..., None], 0, 255).astype(np.uint8)


def lettered(columns: int, rows: int, texels: int, seed: int) -> Image:
    """A patchwork with a letter or numeral on every cell."""
    import cv2

    rng = np.random.default_rng(seed)
    letters = "ABCDEFGHJKLMNPRSTUVWXYZ23456789"
    picture = np.empty((rows * texels, columns * texels, 3), np.uint8)
    for i in range(rows):
        for j in range(columns):
            ground, figure = (PALETTE[k] for k in rng.choice(len(PALETTE), 2, replace=False))
            cell = np.full((4 * texels, 4 * texels, 3), ground, np.uint8)
            letter, scale = letters[rng.integers(len(letters))], 4 * texels / 30
            thick = max(int(4 * texels / 7), 2)
            (w, h), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
            place = ((4 * texels - w) // 2, (4 * texels + h) // 2)
            cv2.putText(cell, letter, place, cv2.FONT_HERSHEY_SIMPLEX, scale, figure, thick, cv2.LINE_AA)
            cell = cv2.resize(cell, (texels, texels), interpolation=cv2.INTER_AREA)
            picture[i * texels : (i + 1) * texels, j * texels : (j + 1) * texels] = cell
    return picture


def patchwork(side: int, squares: int, texels: int, seed: int) -> Image:
    """A fine checkerboard for an atlas of side x side charts; neighbouring charts differ in colour."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(side):
        dark = [PALETTE[k] for k in rng.choice([1, 2, 4, 5, 6], side)]
        rows.append(np.concatenate([checkerboard(squares, squares, texels, CREAM, d) for d in dark], 1))
    return np.concatenate(rows, 0)
