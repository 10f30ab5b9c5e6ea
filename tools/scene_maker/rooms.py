"""Rooms, tables and a garden for the reflectors to stand in: everything diffuse and textured without repetition."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from scene_maker import textures as tx
from scene_maker.model import Light
from scene_maker.solids import Surface, Texture, box, ellipsoid, panel, revolved, with_texture


@dataclass(frozen=True)
class Brush:
    """Draws textures from one stream of random numbers; `detail` scales their number of texels (tests draw few)."""

    rng: np.random.Generator
    detail: float = 1.0

    def __call__(self, function: Callable[..., np.ndarray], *arguments: Any) -> Texture:
        """A texture function of `textures` with its arguments filled in."""

        def draw(height: int, width: int) -> np.ndarray:
            return function(self.rng, *(max(round(n * self.detail), 12) for n in (height, width)), *arguments)

        return draw


def _furniture(brush: Brush, x: float, y: float) -> list[Surface]:
    """Furniture along the walls of a room whose walls are at +-x and +-y; the middle stays free."""
    wood, shapes, mottled = (partial(brush, f) for f in (tx.planks, tx.shapes, tx.mottled))
    books = brush(tx.books)
    parts = [
        # Back wall (+y): a bookcase and a chest; a box's front faces -y.
        box((-1.25, y - 0.18, 0), (1.3, 0.34, 1.75), wood(), front=books),
        box((0.75, y - 0.24, 0), (1.15, 0.46, 0.85), wood(tx.GREEN), front=shapes(tx.GREEN, 0.8)),
        box((0.5, y - 0.25, 0.85), (0.34, 0.26, 0.4), shapes(tx.BRIGHT), 0.2, front=brush(tx.label, "MAPS", tx.BRIGHT)),
        box((1.05, y - 0.25, 0.85), (0.3, 0.22, 0.24), shapes(tx.WARM), -0.3, front=brush(tx.label, "SALT", tx.COOL)),
        # Front wall (-y): sofa with cushions.
        box((0.1, -y + 0.5, 0), (2.1, 0.85, 0.42), shapes(tx.COOL)),
        box((0.1, -y + 0.16, 0.42), (2.1, 0.22, 0.45), shapes(tx.COOL)),
        box((-1.05, -y + 0.5, 0.42), (0.2, 0.8, 0.22), shapes(tx.PLUM)),
        box((1.25, -y + 0.5, 0.42), (0.2, 0.8, 0.22), shapes(tx.PLUM)),
        # Left wall (-x): cabinet with boxes.
        box((-x + 0.22, 0.2, 0), (1.25, 0.4, 1.0), wood(tx.WARM), np.pi / 2, front=shapes(tx.WARM, 0.7)),
        box((-x + 0.24, 0.5, 1.0), (0.4, 0.28, 0.3), shapes(tx.COOL), 1.4, front=brush(tx.label, "FISH", tx.COOL)),
        box((-x + 0.24, -0.1, 1.0), (0.3, 0.26, 0.42), shapes(tx.GREEN), 1.7, front=brush(tx.label, "RICE", tx.GREEN)),
        # Right wall (+x): a low shelf below the window.
        box((x - 0.2, -0.3, 0), (1.6, 0.36, 0.6), wood(), -np.pi / 2, front=brush(tx.books, 2)),
    ]
    surfaces = [face for part in parts for face in part]
    for place, tilt in ((-0.55, 0.3), (0.3, 0.25), (0.75, 0.35)):
        cushion = ellipsoid((0.24, 0.1, 0.22), 24, 40)
        painted = with_texture(cushion, shapes(tx.BRIGHT if place > 0 else tx.WARM), 0.5, 0.8, 300)
        surfaces.append(painted.moved((place, -y + 0.42, 0.62), place, tilt))
    # A potted tree in a corner and a floor lamp in another.
    pot = revolved(np.array([[0.0, 0.42], [0.2, 0.42], [0.22, 0.4], [0.16, 0.02], [0.15, 0.0]]))
    surfaces.append(with_texture(pot, shapes(tx.WARM), 0.45, 1.2).moved((x - 0.42, y - 0.42, 0)))
    trunk = revolved(np.array([[0.03, 1.3], [0.04, 0.4]]), 24)
    surfaces.append(with_texture(trunk, mottled(tx.WOOD, 20), 0.9, 0.3).moved((x - 0.42, y - 0.42, 0)))
    for _ in range(9):
        crown = ellipsoid(brush.rng.uniform(0.12, 0.24, 3), 20, 32)
        offset = brush.rng.normal(0, (0.13, 0.13, 0.22))
        leaves = with_texture(crown, shapes(tx.GREEN, 1.6), 0.4, 0.9)
        surfaces.append(leaves.moved((x - 0.45 + offset[0], y - 0.45 + offset[1], 1.35 + offset[2])))
    shade = revolved(np.array([[0.13, 1.62], [0.22, 1.28]]))
    surfaces.append(with_texture(shade, shapes(tx.PLUM), 0.4, 1.2).moved((-x + 0.4, -y + 0.4, 0)))
    stem = revolved(np.array([[0.025, 1.5], [0.03, 0.03], [0.16, 0.0]]), 24)
    surfaces.append(with_texture(stem, mottled(tx.STONE, 20), 1.5, 0.3).moved((-x + 0.4, -y + 0.4, 0)))
    return surfaces


def room(brush: Brush, x: float = 2.75, y: float = 2.5, height: float = 2.7) -> tuple[list[Surface], list[Light]]:
    """A furnished living room with walls at +-x and +-y, a window in the right wall and light panels in the ceiling."""
    wall, density = partial(brush, tx.wallpaper), 200.0
    surfaces = [
        panel((-x, y, height), (2 * x, 0, 0), (0, 0, -height), wall(tx.COOL), density),
        panel((x, -y, height), (-2 * x, 0, 0), (0, 0, -height), wall(tx.PLUM), density),
        panel((-x, -y, height), (0, 2 * y, 0), (0, 0, -height), wall(tx.WARM), density),
        panel((x, y, height), (0, -2 * y, 0), (0, 0, -height), wall(tx.GREEN), density),
        panel((-x, y, 0), (2 * x, 0, 0), (0, -2 * y, 0), brush(tx.planks), density),
        panel((-x, -y, height), (2 * x, 0, 0), (0, 2 * y, 0), brush(tx.shapes, tx.CREAM, 0.5), density),
        panel((-1.5, 1.25, 0.004), (3.1, 0.2, 0), (0.15, -2.4, 0), brush(tx.shapes, tx.PLUM, 1.2), density),
    ]
    for at in (-1.3, 0.0, 1.3):
        surfaces += box((at, 0, height - 0.12), (0.14, 2 * y - 0.02, 0.12), brush(tx.planks))
    words = partial(brush, tx.poster)
    hung = 0.012
    surfaces += [
        panel((-0.1, y - hung, 2.35), (0.75, 0, 0), (0, 0, -0.85), words(["LOOK", "AGAIN"], tx.BRIGHT), 320),
        panel((0.85, y - hung, 2.3), (0.8, 0, 0), (0, 0, -0.62), brush(tx.picture, tx.COOL), 320),
        panel((0.2, -y + hung, 2.3), (-1.2, 0, 0), (0, 0, -0.9), words(["NORTH", "7 KM"], tx.BRIGHT[2:]), 320),
        panel((1.5, -y + hung, 2.25), (-0.85, 0, 0), (0, 0, -1.0), brush(tx.picture, tx.BRIGHT), 320),
        panel((-1.4, -y + hung, 2.2), (-0.7, 0, 0), (0, 0, -0.9), words(["TEA", "AND", "CAKE"], tx.WARM), 320),
        panel((-x + hung, -1.5, 2.3), (0, 1.0, 0), (0, 0, -1.1), words(["RED", "FOX"], tx.BRIGHT), 320),
        panel((-x + hung, -0.2, 2.4), (0, 0.9, 0), (0, 0, -0.65), brush(tx.picture, tx.WARM), 320),
        panel((-x + hung, 1.15, 2.35), (0, 0.85, 0), (0, 0, -1.1), words(["1927", "JAZZ"], tx.PLUM), 320),
        panel((x - hung, -1.35, 2.3), (0, -0.85, 0), (0, 0, -1.1), words(["OPEN", "SKY"], tx.COOL), 320),
    ]
    surfaces += _furniture(brush, x, y)
    frame = brush(tx.planks)
    for at, size in (((x - 0.04, 0, 0.86), (2.05, 0.07, 0.07)), ((x - 0.04, 0, 2.27), (2.05, 0.07, 0.07))):
        surfaces += box(at, size, frame, np.pi / 2)
    view = tx.window(brush.rng, 260, 380)
    lights = [Light((x - 0.02, 0.98, 2.28), (0, -1.96, 0), (0, 0, -1.36), (5.5, 5.5, 5.5), view)]
    for at in (-0.65, 0.65):
        for side in (-1.2, 0.5):
            corner = (at - 0.3, side, height - 0.01)
            lights.append(Light(corner, (0.6, 0, 0), (0, 0.8, 0), (15.0, 13.8, 12.0)))
    return surfaces, lights


def table(brush: Brush, size: tuple[float, float] = (1.1, 1.1), top: float = 0.72) -> list[Surface]:
    """A table about the origin, its top painted at high density."""
    a, b = size
    parts = box((0, 0, top - 0.05), (a, b, 0.05), brush(tx.planks, tx.WOOD), density=420)
    cloth = panel((-a / 2 + 0.06, b / 2 - 0.05, top + 0.002), (a - 0.12, 0, 0), (0, -b + 0.1, 0),
                  brush(tx.shapes, [*tx.WARM, *tx.CREAM, *tx.COOL], 0.9), 480)  # fmt: skip
    for sx in (-1, 1):
        for sy in (-1, 1):
            place = (sx * (a / 2 - 0.06), sy * (b / 2 - 0.06), 0)
            parts += box(place, (0.07, 0.07, top - 0.05), brush(tx.planks))
    return [*parts, cloth]


def tableware(brush: Brush, top: float = 0.72, reach: float = 0.42, center: float = 0.0) -> list[Surface]:
    """Small things on a table around (center, 0): books, packets, cups, an orange."""
    things: list[Surface] = []
    words = ["MINT", "COCOA", "PEAS", "OATS"]
    for i, turn in enumerate(np.arange(4) * np.pi / 2 + 0.6):
        place = (center + reach * np.cos(turn), reach * np.sin(turn), top + 0.002)
        front = brush(tx.label, words[i], tx.BRIGHT)
        size = (0.15, 0.07, brush.rng.uniform(0.08, 0.13)) if i % 2 else (0.2, 0.15, 0.045)
        yaw = turn + np.pi / 2 + brush.rng.uniform(-0.3, 0.3)
        things += box(place, size, brush(tx.shapes, tx.BRIGHT, 0.35), yaw, 600, front)
    cup = revolved(np.array([[0.0, 0.015], [0.034, 0.02], [0.04, 0.085], [0.043, 0.085], [0.04, 0.0], [0.0, 0.0]]))
    for turn, palette in ((1.45, tx.COOL), (3.0, tx.WARM), (4.7, tx.GREEN)):
        place = (center + reach * 1.02 * np.cos(turn), reach * 1.02 * np.sin(turn), top + 0.002)
        things.append(with_texture(cup, brush(tx.shapes, palette), 0.25, 0.27, 700).moved(place))
    orange = with_texture(ellipsoid((0.04, 0.04, 0.038), 24, 40), brush(tx.shapes, tx.WARM), 0.13, 0.25, 800)
    return [*things, orange.moved((center + reach * np.cos(5.9), reach * np.sin(5.9), top + 0.04))]


def garden(brush: Brush) -> list[Surface]:
    """A paved yard in a meadow: crates and pots near, a fence with signs and hedges further, trees and houses far."""
    shapes = partial(brush, tx.shapes)
    surfaces = [
        panel((-45, 45, -0.03), (90, 0, 0), (0, -90, 0), brush(tx.shapes, tx.GREEN, 1.4), 22),
        panel((-3.5, 3.5, 0), (7, 0, 0), (0, -7, 0), brush(tx.mosaic, [*tx.STONE, *tx.CREAM[:3], tx.WARM[1]], 42), 170),
    ]
    words = [["APPLES", "PEARS"], ["MIND", "THE", "DOG"], ["GATE 4"], ["EGGS", "TODAY"]]
    for i, turn in enumerate(np.radians([20.0, 112.0, 197.0, 290.0])):
        # Four pieces of fence around the yard, each facing its middle.
        fence = box((0, 0, 0), (3.0, 0.08, 1.25 + 0.1 * i), brush(tx.planks, tx.WOOD if i % 2 else tx.STONE), 0.0, 160)
        sign = panel((-0.5, -0.06, 1.2), (1.0, 0, 0), (0, 0, -0.8), brush(tx.poster, words[i], tx.BRIGHT), 260)
        place = (3.6 * np.cos(turn), 3.6 * np.sin(turn), 0.0)
        surfaces += [part.moved(place, turn - np.pi / 2) for part in [*fence, sign]]
    for i, turn in enumerate(np.radians([62.0, 155.0, 243.0, 335.0])):
        place = (2.7 * np.cos(turn), 2.7 * np.sin(turn), 0.0)
        front = brush(tx.label, ("HONEY", "SEEDS", "PLUMS", "TOOLS")[i], tx.BRIGHT)
        surfaces += box(place, (0.75, 0.55, 0.6), brush(tx.planks), turn - np.pi / 2, 220, front)
        pot = revolved(np.array([[0.0, 0.42], [0.2, 0.42], [0.22, 0.4], [0.16, 0.02], [0.15, 0.0]]))
        place = (2.5 * np.cos(turn + 0.42), 2.5 * np.sin(turn + 0.42), 0.0)
        surfaces.append(with_texture(pot, shapes(tx.WARM), 0.45, 1.2, 220).moved(place))
        bush = with_texture(ellipsoid((0.34, 0.34, 0.3), 24, 40), shapes(tx.GREEN, 1.6), 0.9, 2.0, 180)
        surfaces.append(bush.moved((place[0], place[1], 0.62)))
    for turn in np.radians(np.arange(0, 360, 24) + brush.rng.uniform(-8, 8, 15)):
        reach, size = brush.rng.uniform(7, 17), brush.rng.uniform(1.2, 2.4)
        place = np.array([reach * np.cos(turn), reach * np.sin(turn), 0.0])
        trunk = revolved(np.array([[0.1 * size, 1.6 * size], [0.14 * size, 0.0]]), 24)
        surfaces.append(with_texture(trunk, brush(tx.mottled, tx.WOOD, 20), 2.0, 0.8, 60).moved(place))
        for _ in range(3):
            crown = ellipsoid(size * brush.rng.uniform(0.55, 1.0, 3), 20, 32)
            offset = size * (brush.rng.normal(0, 0.35, 3) + (0, 0, 2.0))
            surfaces.append(with_texture(crown, shapes(tx.GREEN, 1.6), 3.0, 6.0, 45).moved(place + offset))
    for i, turn in enumerate(np.radians([45.0, 138.0, 225.0, 318.0])):
        place = (22 * np.cos(turn), 22 * np.sin(turn), 0.0)
        wall = brush(tx.mosaic, (tx.WARM, tx.CREAM, tx.STONE, tx.PLUM)[i], 16)
        surfaces += box(place, (9, 6, 5.0 + i), wall, turn - np.pi / 2 + 0.2, 28)
    return surfaces
