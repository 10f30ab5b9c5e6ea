"""Images in quadrics in native code against PyTorch's, and against finite differences."""

import pytest
import torch
from splatter import needs_native

from catacaustics.reflectors.fermat import path_over
from catacaustics.reflectors.warps import QuadricWarp, painted

pytestmark = needs_native

CENTER = torch.tensor([0.1, 0.2, 0.3])
EYE = torch.tensor([0.2, -2.0, 0.5])
SHAPES = {
    "sphere": (torch.eye(3) / 2, True, False),
    "ellipsoid": (torch.diag(torch.tensor([0.5, 0.3, 0.7])), False, False),
    "thin": (torch.diag(torch.tensor([0.5, 0.02, 0.7])), False, False),
    "concave": (torch.diag(torch.tensor([0.5, 0.45, 0.55])), False, True),
}
TOLERANCE = {torch.float64: 1e-9, torch.float32: 2e-4}


def mirror(name, dtype):
    axes, sphere, concave = SHAPES[name]
    warp = QuadricWarp(CENTER, axes, sphere=sphere, concave=concave)
    if warp.turn is not None:
        warp.turn.data = torch.tensor([0.3, -0.2, 0.5])
    return warp.to(dtype)


def sources_around(count, dtype, least=1.1):
    """Outside of the ellipsoids, from close to far."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    distances = least * torch.exp(2 * torch.rand(count, 1, generator=generator))
    return (CENTER + distances * directions).to(dtype)


def shown(backend, warp, sources, monkeypatch, eye=EYE):
    """What the warp displays, and the gradients of a weighted sum of visible positions."""
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    sources, eye = sources.clone().requires_grad_(), eye.to(sources).detach().clone().requires_grad_()
    warp.zero_grad(set_to_none=True)
    found = warp(sources, eye)
    weights = torch.linspace(0.3, 1.7, 3 * len(found.positions), dtype=sources.dtype).view(-1, 3)
    again = warp(sources, eye, found.start)
    assert torch.equal(again.positions, found.positions)
    assert torch.equal(again.near, found.near)
    (again.positions * weights)[found.visible].sum().backward()
    gradients = {"sources": sources.grad, "camera": eye.grad} | {n: p.grad for n, p in warp.named_parameters()}
    return found, gradients


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", SHAPES)
def test_native_images_and_gradients_are_those_of_pytorch(name, dtype, monkeypatch):
    warp, sources = mirror(name, dtype), sources_around(3001, dtype)
    want, want_gradients = shown("reference", warp, sources, monkeypatch)
    got, gradients = shown("cpu", warp, sources, monkeypatch)
    assert want.visible.sum() > 1000
    assert torch.equal(got.visible, want.visible)
    for field in ("positions", "normals", "stretch", "near", "start"):
        a, b = (getattr(t, field).detach()[want.visible] for t in (got, want))
        # The tilt of a nearly round disk and solutions at the rim are the worst determined.
        scale = 30 if field in ("normals", "start") else 1
        torch.testing.assert_close(a, b, rtol=0, atol=scale * TOLERANCE[dtype] * float(b.abs().max()), msg=field)
    for key, value in want_gradients.items():
        largest = float(value.abs().max())
        torch.testing.assert_close(gradients[key], value, rtol=0, atol=30 * TOLERANCE[dtype] * largest, msg=key)


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_agree_with_finite_differences(name, monkeypatch):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu")
    warp, sources = mirror(name, torch.float64), sources_around(40, torch.float64)
    with torch.no_grad():
        sources = sources[warp(sources, EYE.double()).visible][:7]
    parameters = dict(warp.named_parameters())

    def positions(sources, eye, *values):
        named = dict(zip(parameters, values, strict=True))
        return torch.func.functional_call(warp, named, (sources, eye)).positions

    inputs = [t.detach().clone().requires_grad_() for t in (sources, EYE.double(), *parameters.values())]
    assert len(sources) == 7
    assert torch.autograd.gradcheck(positions, inputs, eps=1e-6, atol=1e-6)


def test_sources_close_to_an_ellipsoid_are_found_too(monkeypatch):
    """Newton's method alone jumps to and fro there. All that both sides find is a path of light."""
    warp = mirror("ellipsoid", torch.float64)
    center, axes = (t.detach() for t in warp.shape())
    unit = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    sources = center + (1.03 * unit.double()) @ axes.T
    normal = torch.nn.functional.normalize(unit.double() @ torch.linalg.inv(axes), dim=1)
    # A source that faces the camera from just above the mirror is mirrored somewhere near.
    facing = (normal * torch.nn.functional.normalize(EYE - sources, dim=1)).sum(1) > 0.1
    for backend in ("reference", "cpu"):
        found, _ = shown(backend, warp, sources[facing], monkeypatch)
        assert found.visible.all(), backend
        points = center + found.start @ axes.T
        path = path_over(points, sources[facing], EYE.double())
        along = path.to_camera + path.to_source
        across = torch.nn.functional.normalize(found.start @ torch.linalg.inv(axes), dim=1)
        assert (along - (along * across).sum(1, keepdim=True) * across).norm(dim=1).max() < 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_sources_anywhere_give_finite_answers(dtype, monkeypatch):
    """Inside, in the centre, on the mirror, behind it, in line with the camera, at the camera, far away."""
    warp = mirror("sphere", dtype)
    special = torch.stack([CENTER, CENTER + torch.tensor([0.0, 0, 0.5]), 2 * CENTER - EYE, EYE, (CENTER + EYE) / 2])
    sources = torch.cat([special, CENTER + 0.2 * torch.eye(3), 1e6 * torch.eye(3)]).to(dtype)
    found, gradients = shown("cpu", warp, sources, monkeypatch)
    for value in (found.positions, found.normals, found.stretch, found.near, *gradients.values()):
        assert torch.isfinite(value).all()
    assert not found.visible[[0, 2]].any()
    assert found.visible[4], "a source between camera and ball is seen in its middle"


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch):
    threads = torch.get_num_threads()
    warp, sources = mirror("ellipsoid", torch.float32), sources_around(20_000, torch.float32)
    runs = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found, gradients = shown("cpu", warp, sources, monkeypatch)
            runs.append([*(t for t in found if t is not None), *gradients.values()])
    finally:
        torch.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_no_sources_and_strided_ones_are_taken(monkeypatch):
    warp = mirror("sphere", torch.float32)
    assert shown("cpu", warp, torch.empty(0, 3), monkeypatch)[0].positions.shape == (0, 3)
    sources = sources_around(100, torch.float32)
    strided = torch.stack([sources, sources], 1)[:, 1]
    wide = shown("cpu", warp, strided, monkeypatch)[0]
    assert torch.equal(wide.positions, shown("cpu", warp, sources, monkeypatch)[0].positions)


def test_known_solutions_keep_the_distance_to_the_mirror_for_painting(monkeypatch):
    """A decoupled camera paints reflections on the mirror, with gradients too."""
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu")
    warp, sources = mirror("sphere", torch.float32), sources_around(50, torch.float32)
    first = warp(sources, EYE)
    again = warp(sources, EYE, first.start)
    other = EYE + 0.1
    assert torch.equal(painted(first, EYE, other).positions, painted(again, EYE, other).positions)
