"""A room with glass balls in closed form: frames of refraction baking on the spot, without a path tracer.

The room is the cube [-0.9, 0.9]^3, open towards the camera; each wall has a texture. A ball bends a ray once, at its
front, and mirrors it near its rim, which stands for total internal reflection; or twice, as glass does.
"""

from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from catacaustics.files import write_json
from catacaustics.images import resize, write_image
from catacaustics.refraction import train as training
from catacaustics.refraction.frames import FORMAT, Frame, write_shard

HALF = 0.9
_WALLS = [(0, -1), (0, 1), (1, -1), (1, 1), (2, -1)]


def toy_textures(checks=6, size=48, seed=3):
    """A smooth image for each wall, and a checkerboard on the back wall."""
    rng = np.random.default_rng(seed)
    images = [resize(rng.random((4, 4, 3)).astype(np.float32), size, size) for _ in _WALLS[:-1]]
    rows = np.arange(size) * checks // size
    board = np.where((rows[:, None] + rows) % 2, 0.9, 0.1)[..., None] * np.array([1, 0.9, 0.8])
    return [(image * 255).astype(np.uint8) for image in [*images, board]]


def hit_walls(origins, directions):
    """Point, normal, wall (-1: leaves by the open side) and texture coordinates."""
    far = np.full(origins.shape[:-1], np.inf)
    wall = np.full(far.shape, -1)
    for i, (axis, sign) in enumerate(_WALLS):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (sign * HALF - origins[..., axis]) / directions[..., axis]
        point = origins + np.where(np.isfinite(t), t, 0)[..., None] * directions
        inside = (np.abs(np.delete(point, axis, -1)) <= HALF + 1e-9).all(-1)
        nearer = (t > 1e-6) & (t < far) & inside
        far, wall = np.where(nearer, t, far), np.where(nearer, i, wall)
    point = np.where(wall[..., None] >= 0, origins + np.where(wall >= 0, far, 0)[..., None] * directions, 0)
    normal, uv = np.zeros_like(point), np.zeros((*wall.shape, 2))
    for i, (axis, sign) in enumerate(_WALLS):
        normal[wall == i, axis] = -sign
        uv[wall == i] = np.delete(point, axis, -1)[wall == i] / (2 * HALF) + 0.5
    return point, normal, wall, np.clip(uv, 0, 1 - 1e-6)


def hit_ball(origin, directions, center, radius):
    offset = origin - center
    b = directions @ offset
    disc = b * b - offset @ offset + radius**2
    t = -b - np.sqrt(np.maximum(disc, 0))
    point = origin + t[..., None] * directions
    return (disc > 0) & (t > 0), point, (point - center) / radius


def refract(directions, normals, eta):
    cosine = -(directions * normals).sum(-1, keepdims=True)
    sine2 = eta**2 * (1 - cosine**2)
    return eta * directions + (eta * cosine - np.sqrt(np.maximum(1 - sine2, 0))) * normals


def through_ball(directions, points, normals, ior, radius):
    """Where rays that enter a ball at `points` leave it, and which way."""
    inside = refract(directions, normals, 1 / ior)
    chord = -2 * radius * (inside * normals).sum(-1, keepdims=True)
    back = normals + chord / radius * inside
    return points + chord * inside, refract(inside, -back, ior)


def texture_color(textures, wall, uv):
    """Bilinear, repeating, sRGB in [0, 1]; black where the wall is -1."""
    color = np.zeros((*wall.shape, 3), np.float32)
    for i, image in enumerate(textures):
        at = uv[wall == i][:, ::-1].T * image.shape[0] - 0.5
        for c in range(3):
            color[wall == i, c] = map_coordinates(image[..., c] / 255.0, at, order=1, mode="grid-wrap")
    return color


def view(eye, side, spread=0.42):
    """world_to_clip and unit ray directions of a camera at `eye` that looks along -z."""
    near, far = 0.1, 10.0
    clip = np.array(
        [
            [1 / spread, 0, 0, 0],
            [0, 1 / spread, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = -np.asarray(eye)
    x = ((np.arange(side) + 0.5) / side * 2 - 1) * spread
    rays = np.stack([*np.meshgrid(x, -x), -np.ones((side, side))], -1)
    return clip @ world_to_camera, rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def toy_probe(center, rows, textures):
    """What is seen all around a point, as `Frame.probe`; black where the room is open."""
    polar, azimuth = np.meshgrid(
        (np.arange(rows) + 0.5) / rows * np.pi, ((np.arange(2 * rows) + 0.5) / rows - 1) * np.pi, indexing="ij"
    )
    around = np.sin(polar)[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * polar], -1)
    around[..., 2] = np.cos(polar)
    _, _, wall, uv = hit_walls(np.broadcast_to(center, around.shape), around)
    return (texture_color(textures, wall, uv) * 255).round().astype(np.uint8)


def toy_frame(rng, side=32, screen=64, balls=2, reference=True, textures=None, placed=None, twice=False):
    """A frame with balls at random places, or at those of `placed` (n, 3); `twice`: they bend rays as glass does, but
    no ray passes through two of them."""
    textures = textures or toy_textures()
    eye = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 2.4])
    light = rng.uniform(-0.5, 0.5, 3)
    centers = rng.uniform(-0.45, 0.45, (balls, 3)) if placed is None else np.asarray(placed, float)
    world_to_clip, rays = view(eye, side)
    origin = np.broadcast_to(eye, rays.shape)
    position, normal, wall, uv = hit_walls(origin, rays)
    albedo = texture_color(textures, wall, uv)
    depth = eye[2] - position[..., 2]
    lit = lambda point, normal: 0.3 + 0.7 * np.abs(((light - point) * normal).sum(-1)) / 1.5  # noqa: E731
    direct = np.clip(albedo * lit(position, normal)[..., None], 0, 1)
    k = len(centers)
    mask, first = np.zeros((k, side, side), bool), np.full((side, side), np.inf)
    o_position, o_normal, o_depth = (
        np.zeros((k, side, side, 3)),
        np.zeros((k, side, side, 3)),
        np.zeros((k, side, side)),
    )
    iors = np.float32(1.3) + np.float32(0.1) * np.arange(k, dtype=np.float32)
    bent, start = rays.copy(), position.copy()
    mirrored = np.zeros((side, side), bool)
    for i, center in enumerate(centers):
        hit, point, n = hit_ball(eye, rays, center, 0.35)
        mask[i] = hit
        o_position[i], o_normal[i] = point * hit[..., None], n * hit[..., None]
        o_depth[i] = (eye[2] - point[..., 2]) * hit
        front = hit & (o_depth[i] < first)
        first = np.where(front, o_depth[i], first)
        rim = -(rays * n).sum(-1) < 0.35
        through = np.where(
            rim[..., None], rays - 2 * (rays * n).sum(-1, keepdims=True) * n, refract(rays, n, 1 / iors[i])
        )
        if twice:
            rim, (point, through) = np.zeros_like(rim), through_ball(rays, point, n, iors[i], 0.35)
        bent, start = np.where(front[..., None], through, bent), np.where(front[..., None], point, start)
        mirrored = np.where(front, rim, mirrored)
    refractive = np.isfinite(first)
    landing, l_normal, l_wall, l_uv = hit_walls(start, bent)
    l_wall = np.where(refractive, l_wall, -1)
    lands = (l_wall >= 0)[..., None]
    seen = texture_color(textures, l_wall, l_uv) * lit(landing, l_normal)[..., None]
    image = np.where(refractive[..., None], 0.9 * seen + 0.05, direct) if reference else np.zeros_like(direct)
    _, big = view(eye, screen if reference else 0)
    s_position, _, s_wall, s_uv = hit_walls(np.broadcast_to(eye, big.shape), big)
    probe_position = centers.mean(0) if k else np.zeros(3)
    f = np.float32
    return Frame(
        reference=np.clip(image, 0, 1).astype(f),
        has_reference=reference,
        position=position.astype(f),
        normal=normal.astype(f),
        albedo=albedo,
        depth=depth.astype(f),
        direct=direct.astype(f),
        object_mask=mask,
        object_position=o_position.astype(f),
        object_normal=o_normal.astype(f),
        object_depth=o_depth.astype(f),
        object_ior=iors,
        object_to_world=np.stack([np.column_stack([0.35 * np.eye(3), c]) for c in centers]).astype(f)
        if k
        else np.zeros((0, 3, 4), f),
        refractive=refractive,
        landing=(landing * lands).astype(f),
        landing_uv=(l_uv * lands).astype(f),
        landing_normal=(l_normal * lands).astype(f),
        landing_object=l_wall.astype(np.int8),
        events=refractive.astype(np.int8),
        internal_reflection=mirrored & refractive,
        screen=(texture_color(textures, s_wall, s_uv) * 255).round().astype(np.uint8),
        screen_depth=(eye[2] - s_position[..., 2]).astype(f),
        probe=toy_probe(probe_position, screen // 2 if reference else 0, textures),
        probe_position=probe_position.astype(f),
        world_to_clip=world_to_clip.astype(f),
        camera_position=eye.astype(f),
        parameters=(light + 0.5).astype(f),
    )


def make_toy_frames(folder, side=32, screen=64, seed=0, balls=2, textures=None, twice=False, **counts):
    """A data set of one shard a split on disk, as `catacaustics refract data` writes it."""
    rng = np.random.default_rng(seed)
    textures = textures or toy_textures()
    counts = {"train": 6, "val": 2, "test": 2, "generator": 4} | counts
    shards = []
    for split, count in counts.items():
        reference = split != "generator"
        frames = [toy_frame(rng, side, screen, balls, reference, textures, twice=twice) for _ in range(count)]
        file = f"shards/{split}_0000.npz"
        shards.append(
            {"file": file, "split": split, "frames": count, "sha256": write_shard(Path(folder) / file, frames)}
        )
    names = [f"textures/{i}.png" for i in range(len(textures))]
    for name, image in zip(names, textures, strict=True):
        write_image(Path(folder) / name, image)
    parameters = [{"name": f"light_{axis}", "low": -0.5, "high": 0.5} for axis in "xyz"]
    card = {
        "format": FORMAT,
        "scene": "toy",
        "resolution": side,
        "textures": names,
        "shards": shards,
        "parameters": parameters,
    }
    write_json(Path(folder) / "card.json", card)
    return Path(folder)


def interrupt_parts(monkeypatch, stops: dict[str, int]) -> dict[str, int]:
    """The training of each part named is interrupted, once, before this step of it; returns what has yet to happen."""
    step, left = training._step, dict(stops)

    def interrupted(state, part, *rest):
        if state.step == left.get(part.name):
            del left[part.name]
            raise KeyboardInterrupt
        return step(state, part, *rest)

    monkeypatch.setattr(training, "_step", interrupted)
    return left
