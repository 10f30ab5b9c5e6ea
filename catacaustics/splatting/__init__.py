"""EWA splatting of oriented disks: one entry, several backends that compute the same."""

from torch import Tensor

from catacaustics.cameras import Camera, Viewport
from catacaustics.kernels import Backend, backend_for
from catacaustics.shapes import Float
from catacaustics.splatting import native, reference
from catacaustics.splatting.config import SplatConfig
from catacaustics.splatting.reference import Disks, SplatOutput, check_shapes, check_view, points_in_view

__all__ = ["Backend", "SplatConfig", "SplatOutput", "backend_for", "points_in_view", "splat_points"]


def splat_points(
    positions: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    footprints: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    features: Float[Tensor, "n channels"],
    camera: Camera,
    viewport: Viewport | None = None,
    config: SplatConfig | None = None,
    backend: Backend | None = None,
) -> SplatOutput:
    """Splat oriented disks into a viewport; differentiable in every tensor.

    Points at equal depth keep their input order. The colour is not normalised and has no background: blend one with
    `transmittance`.

    Args:
        positions, normals: world space; normals of unit length.
        footprints: squared radii, world units squared, non-negative, at most 1e15.
        opacities: in [0, 1].
        camera: pinhole camera in world units.
        viewport: pixels to compute; the whole image by default.
        backend: see `backend_for`.

    Raises:
        ValueError: wrong shapes, types or devices, values that are not finite or out of range, in the tensors, the
            camera or the viewport; the argument is named.
        UserError: the backend does not run here.
    """
    disks, viewport = Disks(positions, normals, footprints, opacities, features), viewport or camera.viewport
    check_shapes(**disks._asdict())
    check_view(camera, viewport)
    splat = reference.splat if backend_for(positions.device.type, backend) == "reference" else native.splat
    return splat(disks, camera, viewport, config or SplatConfig())
