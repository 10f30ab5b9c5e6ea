"""The scene: point clouds, warps, environment and renderer; rendered from any camera, saved to one file.

Primary points carry 6 features and rho, the weight of the reflection, which is splatted as a 7th channel so that
nearer diffuse occluders hide the reflector. Reflection features are scaled by rho, primary features by 1 - rho where a
reflection is: the paper does so everywhere, but a volume can be larger than what mirrors. The environment map is
blended with the primary cloud's transmittance. (Paper sections 4 and 5; the sense of rho is ours.)
"""

from collections.abc import Iterator, MutableSequence, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from catacaustics.cameras import Camera, Viewport, pixel_centers
from catacaustics.environment import EnvironmentMap
from catacaustics.errors import UserError
from catacaustics.files import read_tensors, write_tensors
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.reflectors.warps import Displayed, learns_positions, painted, warp_from_state
from catacaustics.renderer import FEATURES, NeuralRenderer
from catacaustics.shapes import Float, Int
from catacaustics.splatting import SplatOutput, points_in_view, splat_points
from catacaustics.splatting.config import SplatConfig

FORMAT = 3

WarpCamera = Camera | Sequence[Camera | None] | None
"""The camera that reflections follow instead of the view's own: one for all reflectors, or one for each (None: the
view's own)."""


class PointParameters(nn.Module):
    """A trainable cloud of oriented disks. Opacities and rho are kept as logits, footprints as logarithms.

    Args:
        positions, normals: (n, 3); reflection points learn no normals, and positions only where `trainable_positions`.
        footprints: (n,) squared radii.
        opacities: (n,) in (0, 1).
        features: (n, 6).
        rho: (n,) weight of the reflection in (0, 1), for primary points.
    """

    def __init__(
        self,
        positions: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        footprints: Float[Tensor, "n"],
        opacities: Float[Tensor, "n"],
        features: Float[Tensor, "n 6"],
        rho: Float[Tensor, "n"] | None = None,
        trainable_positions: bool = True,
    ):
        super().__init__()
        self.positions = nn.Parameter(positions, requires_grad=trainable_positions)
        self.normals = nn.Parameter(normals, requires_grad=rho is not None)
        self.log_footprints = nn.Parameter(torch.log(footprints))
        self.opacity_logits = nn.Parameter(torch.logit(opacities))
        self.features = nn.Parameter(features)
        self.rho_logits = None if rho is None else nn.Parameter(torch.logit(rho))

    def __len__(self) -> int:
        return len(self.positions)


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """No parameter of a module learns inside."""
    learning = [p for p in module.parameters() if p.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)


class Motion(NamedTuple):
    """A rigid motion of the world before a camera, about the camera's centre c: x -> c + rotation (x - c) + shift."""

    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]

    def apply(self, points: Float[Tensor, "n 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        return center + (points - center) @ self.rotation.T + self.shift


class ReflectionDisks(NamedTuple):
    """One reflection cloud as a view shows it: its rows that can land in the viewport (some several times, where a
    mirror shows several images of a point), and their disks."""

    rows: Int[Tensor, "n"]
    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    footprints: Float[Tensor, "n"]
    opacities: Float[Tensor, "n"]
    features: Float[Tensor, "n 6"]


class Layers(NamedTuple):
    """What the splatter made for one view: feature images, rho, transmittances, depth, and the primary splats."""

    primary: Float[Tensor, "height width 6"]
    reflection: Float[Tensor, "height width 6"]
    rho: Float[Tensor, "height width"]
    reflection_transmittance: Float[Tensor, "height width"]
    transmittance: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    directions: Float[Tensor, "height width 3"]
    splats: SplatOutput


class RenderOutput(NamedTuple):
    """A rendered view. `primary_rgb` is the scene without reflections, `reflection_rgb` reflections alone, unweighted;
    `reflection_weight` is the reflection's share; `alpha` the opacity of the primary cloud; `depth` its mean depth (0
    where empty)."""

    rgb: Float[Tensor, "height width 3"]
    primary_rgb: Float[Tensor, "height width 3"]
    reflection_rgb: Float[Tensor, "height width 3"]
    reflection_weight: Float[Tensor, "height width"]
    alpha: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]


class Scene(nn.Module):
    """A trained or trainable scene. Clouds, warps and volumes of reflector i have index i.

    Args:
        primary: the primary cloud, with rho.
        reflections: one cloud a reflector.
        warps: one warp a reflector (reflectors/warps.py).
        volumes: one reflection volume a reflector.
        environment: features by direction, or None.
        renderer: decodes features to colour.
        splatting: cut-offs of the splatter.
    """

    reflections: MutableSequence[PointParameters]
    warps: MutableSequence[nn.Module]

    def __init__(
        self,
        primary: PointParameters,
        reflections: list[PointParameters],
        warps: list[nn.Module],
        volumes: list[ReflectionVolume],
        environment: EnvironmentMap | None,
        renderer: NeuralRenderer,
        splatting: SplatConfig,
    ):
        super().__init__()
        self.primary = primary
        self.set_reflectors(reflections, warps, volumes)
        self.environment = environment
        self.renderer = renderer
        self.splatting = splatting

    @property
    def device(self) -> torch.device:
        return self.primary.positions.device

    def set_reflectors(
        self, reflections: list[PointParameters], warps: list[nn.Module], volumes: list[ReflectionVolume]
    ) -> None:
        """Replace all reflectors: one cloud, warp and volume each."""
        self.reflections = cast("MutableSequence[PointParameters]", nn.ModuleList(reflections))
        self.warps = cast("MutableSequence[nn.Module]", nn.ModuleList(warps))
        self.volumes = volumes

    def layers(
        self,
        camera: Camera,
        viewport: Viewport | None = None,
        warp_camera: WarpCamera = None,
        motion: Motion | None = None,
    ) -> Layers:
        """Splat all clouds; differentiable. `warp_camera` decouples what is reflected from where it is seen from: the
        reflections that it sees are painted on the mirrors; `motion` corrects the camera's pose, with gradients."""
        viewport = viewport or camera.viewport
        directions = self._directions(camera, viewport)
        if motion is not None:
            directions = directions @ motion.rotation
        splats = self._splat_primary(camera, viewport, motion)
        image, through = splats.image, splats.transmittance
        rho = image[..., FEATURES]
        primary = image[..., :FEATURES]
        if self.environment is not None:
            primary = primary + through[..., None] * self.environment(directions)
        reflection, reflection_through = self._splat_reflections(camera, viewport, warp_camera, motion)
        alpha = 1 - through
        depth = image[..., FEATURES + 1] / torch.where(alpha > 1e-4, alpha, torch.inf)
        return Layers(primary, reflection, rho, reflection_through, through, depth, directions, splats)

    def openings(self, camera: Camera) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
        """Viewing directions, and how open the primary cloud is along them, whatever is reflected."""
        viewport = camera.viewport
        return self._directions(camera, viewport), self._splat_primary(camera, viewport, None).transmittance

    def decode(self, layers: Layers) -> Float[Tensor, "height width 3"]:
        """RGB of splatted layers, not clamped: training needs the gradient outside [0, 1] too."""
        return self.renderer(*_weighted(layers), layers.directions)

    def render(self, camera: Camera, viewport: Viewport | None = None, warp_camera: WarpCamera = None) -> RenderOutput:
        """Render a view in [0, 1] with the layers people look at (no gradients)."""
        with torch.no_grad():
            layers = self.layers(camera, viewport, warp_camera)
            nothing = torch.zeros_like(layers.primary)
            return RenderOutput(
                self._decode_strips(*_weighted(layers), layers.directions),
                self._decode_strips(layers.primary, nothing, layers.directions),
                self._decode_strips(nothing, layers.reflection, layers.directions),
                layers.rho * (1 - layers.reflection_transmittance),
                1 - layers.transmittance,
                layers.depth,
            )

    def _decode_strips(self, primary: Tensor, reflection: Tensor, directions: Tensor) -> Tensor:
        """RGB in [0, 1], some rows at a time: activations of a whole image would not fit the processor's caches."""
        rows = max(1, 16_384 // max(1, primary.shape[1]))
        strips = zip(*(t.split(rows) for t in (primary, reflection, directions)), strict=True)
        return torch.cat([self.renderer(*strip) for strip in strips]).clamp(0, 1)

    def _directions(self, camera: Camera, viewport: Viewport) -> Tensor:
        rays = torch.from_numpy(camera.ray_directions(pixel_centers(viewport))).to(self.primary.positions)
        return torch.nn.functional.normalize(rays, dim=-1)

    def _splat_primary(self, camera: Camera, viewport: Viewport, motion: Motion | None) -> SplatOutput:
        cloud = self.primary
        with torch.no_grad():
            footprints = cloud.log_footprints.exp()
        near = points_in_view(cloud.positions.detach(), footprints, camera, viewport, self.splatting)
        positions, normals, log_footprints, logits, features = _rows(cloud, near)
        if motion is not None:
            positions = motion.apply(positions, self._center(camera))
            normals = normals @ motion.rotation.T
        forward = torch.tensor(camera.camera_from_world[2], dtype=positions.dtype, device=self.device)
        depth = positions.detach() @ forward[:3] + forward[3]
        assert cloud.rho_logits is not None
        rho = torch.sigmoid(cloud.rho_logits.index_select(0, near))
        output = splat_points(
            positions,
            torch.nn.functional.normalize(normals, dim=1),
            log_footprints.exp(),
            torch.sigmoid(logits),
            torch.cat([features, rho[:, None], depth[:, None]], 1),
            camera,
            viewport,
            self.splatting,
        )
        return output._replace(visible=near[output.visible])

    def _center(self, camera: Camera) -> Tensor:
        return torch.tensor(camera.center, dtype=self.primary.positions.dtype, device=self.device)

    def reflector_order(self, camera: Camera) -> list[int]:
        """Reflectors from near to far: nearer ones hide farther ones."""
        distances = [float(np.linalg.norm(v.center - camera.center)) for v in self.volumes]
        return np.argsort(distances, kind="stable").tolist()

    def _splat_reflections(
        self, camera: Camera, viewport: Viewport, warp_camera: WarpCamera, motion: Motion | None
    ) -> tuple[Tensor, Tensor]:
        """All reflection clouds over each other, nearer reflectors first."""
        like = self.primary.positions
        image = like.new_zeros(viewport.height, viewport.width, FEATURES)
        through = like.new_ones(viewport.height, viewport.width)
        for i in self.reflector_order(camera):
            own = warp_camera if isinstance(warp_camera, Camera | None) else warp_camera[i]
            disks = self.reflection_disks(i, camera, viewport, own, motion)
            output = splat_points(*disks[1:], camera, viewport, self.splatting)
            image = image + through[..., None] * output.image
            through = through * output.transmittance
        return image, through

    def reflection_disks(
        self,
        index: int,
        camera: Camera,
        viewport: Viewport | None = None,
        warp_camera: Camera | None = None,
        motion: Motion | None = None,
    ) -> ReflectionDisks:
        """The points of reflection cloud `index` as a view shows them, ready to splat; differentiable. Sources are
        round; where the warp does not shape their images, disks face the camera."""
        viewport = viewport or camera.viewport
        cloud, warp = self.reflections[index], self.warps[index]
        center, warp_center = self._center(camera), self._center(warp_camera or camera)
        decoupled = warp_camera is not None and not torch.equal(center, warp_center)
        if motion is not None:
            warp_center = warp_center - motion.shift @ motion.rotation  # where the corrected camera stands

        def show(points: Tensor, start: Tensor | None = None) -> Displayed:
            shown = warp(points, warp_center, start)
            return painted(shown, warp_center, center) if decoupled else shown

        with torch.no_grad():
            shown = show(cloud.positions)
            footprints = cloud.log_footprints.exp()
            footprints = _stretched(footprints if shown.rows is None else footprints[shown.rows], shown.stretch)
            near = points_in_view(shown.positions, footprints, camera, viewport, self.splatting)
            if shown.visible is not None:
                near = near[shown.visible[near]]
            normals, stretch, start = (
                None if t is None else t.index_select(0, near) for t in (shown.normals, shown.stretch, shown.start)
            )
            rows = near if shown.rows is None else shown.rows[near]
        # Only points that can land in the viewport are warped with gradients, and only positions have them.
        positions, _, log_footprints, logits, features = _rows(cloud, rows)
        displayed = show(positions, start).positions
        if motion is not None:
            displayed = motion.apply(displayed, center)
            normals = None if normals is None else normals @ motion.rotation.detach().T
        if normals is None:
            normals = torch.nn.functional.normalize(center - displayed.detach(), dim=1)
        footprints = _stretched(log_footprints.exp(), stretch)
        return ReflectionDisks(rows, displayed, normals, footprints, torch.sigmoid(logits), features)

    def save(self, path: Path, extra: dict[str, Tensor] | None = None, notes: dict | None = None) -> None:
        """Write the scene, atomically, as one safetensors file; `extra` tensors and JSON `notes` travel along."""
        tensors = {f"scene.{k}": v for k, v in self.state_dict().items()}
        for i, volume in enumerate(self.volumes):
            tensors[f"volumes.{i}.halfspaces"] = torch.from_numpy(np.ascontiguousarray(volume.halfspaces))
            tensors[f"volumes.{i}.vertices"] = torch.from_numpy(np.ascontiguousarray(volume.vertices))
            tensors[f"volumes.{i}.faces"] = torch.from_numpy(np.ascontiguousarray(volume.faces))
        tensors |= extra or {}
        header = {
            "format": FORMAT,
            "reflectors": [v.name for v in self.volumes],
            "splatting": vars(self.splatting),
            "notes": notes or {},
        }
        write_tensors(path, tensors, header)

    @staticmethod
    def load(path: Path, device: str | torch.device = "cpu") -> "Scene":
        """Read a scene; raises UserError where the file is missing, cut off or of another format."""
        return Scene.load_with_extras(path, device)[0]

    @staticmethod
    def load_with_extras(path: Path, device: str | torch.device = "cpu") -> tuple["Scene", dict[str, Tensor], dict]:
        """A scene with the extra tensors and notes that were saved along."""
        tensors, header = _read_file(Path(path))
        parts = {k.removeprefix("scene."): tensors.pop(k) for k in list(tensors) if k.startswith("scene.")}
        volumes = [
            ReflectionVolume(
                name, *(tensors.pop(f"volumes.{i}.{k}").numpy() for k in ("halfspaces", "vertices", "faces"))
            )
            for i, name in enumerate(header["reflectors"])
        ]
        scene = _from_state(parts, volumes, SplatConfig(**header["splatting"])).to(device)
        return scene, tensors, header["notes"]


def _weighted(layers: Layers) -> tuple[Tensor, Tensor]:
    """Primary features scaled by 1 - w, reflection features by rho (premultiplied by their opacity); w = rho times the
    reflection's opacity: where a mirror shows no reflection, what was learned of its surface remains."""
    rho = layers.rho[..., None]
    return (1 - rho * (1 - layers.reflection_transmittance[..., None])) * layers.primary, rho * layers.reflection


def _stretched(footprints: Tensor, stretch: Tensor | None) -> Tensor:
    return footprints if stretch is None else footprints * stretch


def _rows(cloud: PointParameters, index: Tensor) -> list[Tensor]:
    parts = (cloud.positions, cloud.normals, cloud.log_footprints, cloud.opacity_logits, cloud.features)
    return [t.index_select(0, index) for t in parts]


def _read_file(path: Path) -> tuple[dict[str, Tensor], dict]:
    tensors, header = read_tensors(path, "scene", "catacaustics train")
    if header.get("format") != FORMAT:
        raise UserError(
            f"{path} has scene format {header.get('format')}.", f"format {FORMAT}", "train again with this version"
        )
    return tensors, header


def _from_state(state: dict[str, Tensor], volumes: list[ReflectionVolume], splatting: SplatConfig) -> Scene:
    """Build modules of the sizes that the tensors have, then fill them."""

    def cloud(prefix: str, trainable_positions: bool = True) -> PointParameters:
        n = len(state[f"{prefix}.positions"])
        half = torch.full((n,), 0.5)
        rho = half.clone() if f"{prefix}.rho_logits" in state else None
        return PointParameters(
            torch.zeros(n, 3), torch.zeros(n, 3), half, half.clone(), torch.zeros(n, FEATURES), rho, trainable_positions
        )

    warps = [
        warp_from_state({k.removeprefix(f"warps.{i}."): v for k, v in state.items() if k.startswith(f"warps.{i}.")})
        for i in range(len(volumes))
    ]
    environment = None
    if "environment.features" in state:
        height, width, _ = state["environment.features"].shape
        environment = EnvironmentMap(width, height)
    blocks = {k.split(".")[3] for k in state if k.startswith("renderer.decoder.blocks.")}
    renderer = NeuralRenderer(len(state["renderer.decoder.input.bias"]), 1 + 2 * len(blocks))
    reflections = [cloud(f"reflections.{i}", learns_positions(warp)) for i, warp in enumerate(warps)]
    scene = Scene(cloud("primary"), reflections, warps, volumes, environment, renderer, splatting)
    scene.load_state_dict(state)
    return scene
