"""Procedural textures: every one is drawn once, at several scales, so that stereo finds a match everywhere.

A texture function takes a random generator and a size in pixels and returns (height, width, 3) sRGB bytes.
"""

from collections.abc import Sequence

import numpy as np

from catacaustics.shapes import Float, UInt8

Rng = np.random.Generator
Image = UInt8[np.ndarray, "height width 3"]
Palette = Sequence[tuple[int, int, int]]

WARM: Palette = [(92, 45, 32), (178, 92, 54), (226, 168, 98), (240, 220, 180), (148, 62, 58)]
COOL: Palette = [(28, 52, 84), (58, 108, 140), (128, 176, 182), (214, 226, 218), (92, 110, 150)]
GREEN: Palette = [(40, 66, 42), (96, 130, 64), (168, 182, 110), (226, 224, 178), (70, 98, 86)]
PLUM: Palette = [(62, 34, 66), (128, 66, 104), (196, 128, 138), (236, 208, 196), (84, 78, 124)]
CREAM: Palette = [(176, 158, 130), (206, 190, 160), (228, 216, 190), (240, 232, 214), (190, 178, 160)]
BRIGHT: Palette = [(206, 50, 44), (238, 170, 40), (44, 120, 190), (58, 150, 92), (245, 240, 226), (40, 40, 52)]
WOOD: Palette = [(96, 60, 36), (142, 94, 56), (180, 128, 80), (206, 160, 108), (120, 76, 46)]
STONE: Palette = [(104, 100, 96), (146, 140, 130), (178, 172, 160), (206, 200, 190), (126, 116, 108)]


def noise(rng: Rng, height: int, width: int, cell: float = 128, octaves: int = 6) -> Float[np.ndarray, "height width"]:
    """Fractal value noise in [0, 1]: grids of random values, smoothly enlarged, each octave half the cell size."""
    import cv2

    total, weight = np.zeros((height, width), np.float32), 1.0
    for _ in range(octaves):
        rows, columns = int(height / cell) + 3, int(width / cell) + 3
        grid = rng.random((rows, columns), np.float32) - 0.5
        size = (max(int(columns * cell), width), max(int(rows * cell), height))
        total += weight * cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)[:height, :width]
        weight, cell = weight * 0.62, cell / 2
        if cell < 1.5:
            break
    return (total - total.min()) / (np.ptp(total) + 1e-9)


def _colors(values: np.ndarray, palette: Palette) -> np.ndarray:
    """Colours of a palette interpolated at values in [0, 1]."""
    stops = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(values, stops, [c[i] for c in palette]) for i in range(3)], -1).astype(np.float32)


def _grain(rng: Rng, image: np.ndarray, amount: float = 0.3) -> Image:
    """Brightness variation from coarse to single pixels, so that no part of a texture is flat."""
    height, width = image.shape[:2]
    fine = noise(rng, height, width, 16, 4) - 0.5
    coarse = noise(rng, height, width, max(height, width) / 3, 5) - 0.5
    return np.clip(image * (1 + amount * fine + amount * coarse)[..., None], 0, 255).astype(np.uint8)


def _pick(rng: Rng, palette: Palette) -> tuple[int, int, int]:
    jitter = rng.integers(-18, 19, 3)
    red, green, blue = np.clip(np.array(palette[int(rng.integers(len(palette)))]) + jitter, 0, 255).tolist()
    return red, green, blue


def _blob(rng: Rng, center: np.ndarray, radius: float) -> np.ndarray:
    """A random star-shaped outline with 7 to 12 corners."""
    corners = int(rng.integers(7, 13))
    angle = np.sort(rng.random(corners)) * 2 * np.pi
    reach = radius * rng.uniform(0.45, 1.1, corners)
    return (center + np.stack([np.cos(angle), np.sin(angle)], -1) * reach[:, None]).astype(np.int32)


def mottled(rng: Rng, height: int, width: int, palette: Palette, cell: float = 160) -> Image:
    """Marbled colour without shapes: plaster, stone, grass, fabric."""
    return _grain(rng, _colors(noise(rng, height, width, cell, 7), palette), 0.35)


def shapes(rng: Rng, height: int, width: int, palette: Palette, density: float = 1.0) -> Image:
    """Random blobs, rings and strokes from large to small on a marbled ground: wallpaper, cloth, rugs."""
    import cv2

    image = np.ascontiguousarray(_colors(noise(rng, height, width, min(height, width) / 2, 5), palette))
    scale = min(height, width, 700)
    for radius in (scale / 5, scale / 9, scale / 16, scale / 28):
        if radius < 3:
            break
        count = int(density * 0.16 * height * width / radius**2)
        for _ in range(count):
            center = rng.random(2) * (width, height)
            color, kind = _pick(rng, palette), rng.integers(4)
            if kind <= 1:
                cv2.fillPoly(image, [_blob(rng, center, radius)], color, cv2.LINE_AA)
            elif kind == 2:
                at = (int(center[0]), int(center[1]))
                cv2.circle(image, at, max(int(radius * 0.6), 1), color, max(int(radius / 4), 1), cv2.LINE_AA)
            else:
                turn = rng.random() * np.pi
                reach = radius * 1.3 * np.array([np.cos(turn), np.sin(turn)])
                a, b = (center - reach).astype(int), (center + reach).astype(int)
                cv2.line(image, a.tolist(), b.tolist(), color, max(int(radius / 5), 1), cv2.LINE_AA)
    return _grain(rng, image, 0.28)


def wallpaper(rng: Rng, height: int, width: int, palette: Palette, ground: Palette = CREAM) -> Image:
    """Hand-painted leaves on long stems over a light ground: no two alike."""
    import cv2

    image = np.ascontiguousarray(_colors(noise(rng, height, width, 200, 5), ground))
    stems = max(int(width / 46), 2)
    for x in (np.arange(stems) + rng.random(stems)) / stems * width:
        y, phase, color = -20.0, rng.random() * 6, _pick(rng, palette)
        sway = rng.uniform(10, 30)
        last = None
        while y < height + 20:
            here = np.array([x + sway * np.sin(y / 55 + phase), y])
            if last is not None:
                cv2.line(image, last.astype(int).tolist(), here.astype(int).tolist(), color, 2, cv2.LINE_AA)
                size = rng.uniform(5, 22)
                turn = rng.uniform(0, 360)
                offset = size * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
                leaf = (size, size * rng.uniform(0.25, 0.6))
                box = ((here + offset).tolist(), (2 * leaf[0], 2 * leaf[1]), turn)
                cv2.ellipse(image, box, _pick(rng, palette), -1 if rng.random() < 0.8 else 2, cv2.LINE_AA)
            last, y = here, y + rng.uniform(12, 30)
    return _grain(rng, image, 0.22)


def planks(rng: Rng, height: int, width: int, palette: Palette = WOOD, plank: int = 70) -> Image:
    """Boards of uneven width and length, each with its own hue and grain."""
    image = np.zeros((height, width, 3), np.float32)
    top = 0
    while top < height:
        tall = int(plank * rng.uniform(0.7, 1.3))
        left = -int(rng.integers(0, 5 * plank))
        while left < width:
            long = int(plank * rng.uniform(3, 8))
            rows, columns = slice(top, min(top + tall, height)), slice(max(left, 0), min(left + long, width))
            h, w = rows.stop - rows.start, columns.stop - columns.start
            if w > 0:
                stretch = noise(rng, h, max(w // 9, 2), 12, 4)
                grain = stretch[:, np.minimum(np.arange(w) // 9, stretch.shape[1] - 1)]
                board = _colors(np.clip(0.75 * grain + rng.uniform(-0.1, 0.35), 0, 1), palette)
                board[-2:], board[:, -2:] = board[-2:] * 0.45, board[:, -2:] * 0.45
                image[rows, columns] = board * rng.uniform(0.75, 1.2)
            left += long
        top += tall
    return _grain(rng, image, 0.3)


def mosaic(rng: Rng, height: int, width: int, palette: Palette, cell: float = 40) -> Image:
    """Irregular tiles (Voronoi cells of jittered points) with dark joints: pavement, tiled tables."""
    from scipy.spatial import KDTree

    rows, columns = int(height / cell) + 2, int(width / cell) + 2
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) + rng.random(
        (rows * columns, 2)
    )
    sites = (grid - 0.5) * cell
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)
    distance, owner = (np.asarray(found) for found in KDTree(sites).query(pixels, k=2))
    colors = np.array([_pick(rng, palette) for _ in sites], np.float32)
    joint = np.where(distance[:, 1] - distance[:, 0] < cell * 0.08, 0.45, 1.0)
    return _grain(rng, (colors[owner[:, 0]] * joint[:, None]).reshape(height, width, 3), 0.3)


def _text(image: np.ndarray, text: str, box: tuple[int, int, int, int], color: tuple[int, int, int]) -> None:
    """Draw text as large as fits into the box (left, top, width, height), centred."""
    import cv2

    left, top, width, height = box
    font = cv2.FONT_HERSHEY_DUPLEX
    (w, h), _ = cv2.getTextSize(text, font, 1, 2)
    scale = min(width / w, height / h) * 0.92
    thick = max(int(2.6 * scale), 1)
    (w, h), _ = cv2.getTextSize(text, font, scale, thick)
    cv2.putText(image, text, (left + (width - w) // 2, top + (height + h) // 2), font, scale, color, thick, cv2.LINE_AA)


def poster(rng: Rng, height: int, width: int, lines: Sequence[str], palette: Palette) -> Image:
    """Large letters on a light, mottled sheet with a painted border and a strip of shapes below."""
    sheet = _colors(0.6 + 0.4 * noise(rng, height, width, 90, 4), [(120, 110, 100), *CREAM[2:4]])
    image = np.ascontiguousarray(sheet.astype(np.uint8))
    strip = height // 4
    image[-strip:] = shapes(rng, strip, width, palette, 0.5)
    edge = max(min(height, width) // 28, 3)
    tall = (height - strip - 2 * edge) // len(lines)
    for i, line in enumerate(lines):
        _text(image, line, (2 * edge, edge + i * tall, width - 4 * edge, int(tall * 0.82)), _pick(rng, palette[:3]))
    ring = np.ones((height, width), bool)
    ring[edge:-edge, edge:-edge] = False
    image[ring] = _pick(rng, palette)
    return _grain(rng, image, 0.16)


def picture(rng: Rng, height: int, width: int, palette: Palette) -> Image:
    """A framed abstract painting: large tiles, then strokes."""
    image = mosaic(rng, height, width, palette, min(height, width) / 4.5)
    image = (0.5 * image + 0.5 * shapes(rng, height, width, palette, 0.8)).astype(np.uint8)
    edge = max(min(height, width) // 14, 3)
    frame = planks(rng, height, width, WOOD, edge * 2)
    frame[edge:-edge, edge:-edge] = image[edge:-edge, edge:-edge]
    return frame


def books(rng: Rng, height: int, width: int, shelves: int = 4) -> Image:
    """A filled bookcase seen from the front: spines of uneven width and height with lettering."""
    import cv2

    image = (planks(rng, height, width, WOOD, 24) * 0.35).astype(np.uint8)
    tall = height // shelves
    for s in range(shelves):
        floor, left = (s + 1) * tall - tall // 14, int(width * 0.02)
        while left < width * 0.98:
            thick = int(rng.uniform(0.09, 0.24) * tall)
            high = int(rng.uniform(0.6, 0.9) * tall)
            right = min(left + thick, int(width * 0.98))
            if right - left < 4:
                break
            spine = np.empty((right - left, high, 3), np.uint8)
            spine[:] = _pick(rng, [*BRIGHT, *WARM, *COOL])
            band = int(high * rng.uniform(0.06, 0.2))
            spine[:, band : band + max(high // 20, 2)] = _pick(rng, CREAM)
            word = "".join(rng.choice(list("ABCDEFGHKLMNOPRSTUVWXYZ"), int(rng.integers(3, 8))))
            if right - left > 8:
                _text(spine, word, (high // 4, 1, high * 2 // 3, right - left - 2), _pick(rng, CREAM))
            image[floor - high : floor, left:right] = cv2.rotate(spine, cv2.ROTATE_90_CLOCKWISE)
            left = right + max(int(0.012 * tall), 1)
    for s in range(shelves + 1):
        edge = slice(max(s * tall - tall // 14, 0), s * tall + 2)
        image[edge] = planks(rng, height, width, WOOD, 30)[edge]
    return _grain(rng, image, 0.22)


def label(rng: Rng, height: int, width: int, text: str, palette: Palette) -> Image:
    """A printed packet: shapes with a word across the middle."""
    image = shapes(rng, height, width, palette, 0.4).astype(np.float32)
    band = slice(int(height * 0.3), int(height * 0.7))
    image[band] = 0.25 * image[band] + 0.75 * np.array(_pick(rng, CREAM))
    image = image.astype(np.uint8)
    _text(
        image, text, (int(width * 0.05), band.start, int(width * 0.9), band.stop - band.start), _pick(rng, palette[:3])
    )
    return _grain(rng, image, 0.18)


def window(rng: Rng, height: int, width: int) -> Float[np.ndarray, "height width 3"]:
    """The bright view through a window as linear radiance in [0, 1]: sky, clouds and trees behind crossbars."""
    rows = np.linspace(0, 1, height)[:, None]
    clouds = np.clip(noise(rng, height, width, width / 3, 6) * 1.6 - 0.5, 0, 1)
    sky = np.array([0.55, 0.72, 1.0]) * (0.7 + 0.3 * rows[..., None])
    image = sky + (1 - sky) * clouds[..., None]
    crowns = 0.62 + 0.25 * (noise(rng, 1, width, width / 4, 5)[0] - 0.5)
    leaves = _colors(noise(rng, height, width, 24, 5), GREEN) / 255
    image = np.where((rows > crowns)[..., None], leaves**2.2 * 0.8, image)
    bar = max(width // 60, 2)
    for i in (1, 2):
        image[:, i * width // 3 - bar : i * width // 3 + bar] = 0.06
    image[height // 2 - bar : height // 2 + bar] = 0.06
    return image.astype(np.float32)


def sky(rng: Rng, height: int, width: int, sun: tuple[float, float]) -> Float[np.ndarray, "height width 3"]:
    """A daylight environment map (latitude-longitude, zenith first row) as linear radiance: clouds, soft sun, hills.

    Args:
        sun: column and row of the sun as fractions of the size.
    """
    row, column = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    up = np.clip(np.cos(row * np.pi), 0, 1)
    clear = np.stack([0.42 - 0.22 * up, 0.62 - 0.22 * up, 0.95 - 0.15 * up], -1)
    # Clouds are drawn once and mirrored about the middle column, so that the map closes without a seam.
    half = noise(rng, height, width // 2, width / 10, 7)
    clouds = np.clip(np.concatenate([half, half[:, ::-1]], 1) * 2.2 - 0.85, 0, 1) * np.clip(up * 5, 0, 1)
    image = clear + (1.15 - clear) * clouds[..., None]
    turn = np.minimum(np.abs(column - sun[0]), 1 - np.abs(column - sun[0])) * 2 * np.pi * np.sin(row * np.pi)
    angle2 = turn**2 + ((row - sun[1]) * np.pi) ** 2
    image += np.array([1.0, 0.9, 0.75]) * (26 * np.exp(-angle2 / 0.012) + 0.6 * np.exp(-angle2 / 0.15))[..., None]
    ridge = np.concatenate([r := noise(rng, 1, width // 2, width / 14, 6)[0], r[::-1]])
    hill = row > 0.5 - 0.045 * ridge
    ground = _colors(noise(rng, height, width, 40, 6), GREEN) / 255
    return np.where(hill[..., None], ground**2.2 * 0.7, image).astype(np.float32)
