"""The environment map's lookup: in PyTorch and in native code, values and gradients (see test_renderer.py for what it
shows)."""

import math

import pytest
import torch
from splatter import needs_native

from catacaustics.environment import EnvironmentMap

BACKENDS = pytest.mark.parametrize("backend", ["reference", pytest.param("cpu", marks=needs_native)])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


def random_map(width, height, dtype, seed=0):
    environment = EnvironmentMap(width, height).to(dtype)
    with torch.no_grad():
        environment.features.copy_(
            torch.randn(environment.features.shape, generator=torch.Generator().manual_seed(seed))
        )
    return environment


def everywhere(height, width, dtype, seed=1):
    """Directions all around, with the poles and both sides of where longitude wraps around."""
    directions = torch.randn(height * width, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    special = [[0, 1, 0], [0, -1, 0], [1e-9, 1, 0], [1e-7, 0, -1], [-1e-7, 0, -1], [0, 0, -1], [0, 0, 1], [-0.0, 0, -1]]
    directions[: len(special)] = torch.tensor(special, dtype=torch.float64)
    return torch.nn.functional.normalize(directions, dim=1).to(dtype).view(height, width, 3)


def looked_up(environment, directions):
    """Features, and gradients to the map and to the directions."""
    directions = directions.clone().requires_grad_()
    environment.features.grad = None
    found = environment(directions)
    weights = torch.linspace(-1, 2, found.numel(), dtype=found.dtype).view(found.shape)
    (found * weights).sum().backward()
    return found.detach(), environment.features.grad, directions.grad


@needs_native
@DTYPES
@pytest.mark.parametrize(("width", "height"), [(40, 16), (7, 3), (1, 1), (2, 5)])
def test_native_lookups_and_gradients_agree_with_pytorch(monkeypatch, dtype, width, height):
    environment, directions = random_map(width, height, dtype), everywhere(37, 41, dtype)
    native = looked_up(environment, directions)
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "reference")
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    for got, expected in zip(native, looked_up(environment, directions), strict=True):
        torch.testing.assert_close(got, expected, rtol=tolerance, atol=tolerance * float(expected.abs().max()))


@BACKENDS
def test_gradients_are_those_of_finite_differences(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    environment = random_map(12, 6, torch.float64)
    # In the middle of texels; next to where longitude wraps around; half a texel from a pole and nearer.
    angles = [(0.3, 0.1), (-2.0, -0.7), (math.pi - 0.05, 0.2), (-math.pi + 0.05, -0.4), (1.0, 1.2), (2.0, 1.5)]
    longitude, latitude = torch.tensor(angles, dtype=torch.float64).T
    parts = (longitude.sin() * latitude.cos(), latitude.sin(), longitude.cos() * latitude.cos())
    directions = torch.stack(parts, 1)[None].requires_grad_()
    features = environment.features.detach().clone().requires_grad_()

    def found(features, directions):
        return torch.func.functional_call(environment, {"features": features}, (directions,))

    assert torch.autograd.gradcheck(found, (features, directions), eps=1e-6, atol=1e-7)


@BACKENDS
def test_gradients_to_directions_are_finite_at_the_poles(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    for dtype in (torch.float32, torch.float64):
        assert all(t.isfinite().all() for t in looked_up(random_map(40, 16, dtype), everywhere(3, 5, dtype)))


@BACKENDS
def test_the_gradient_of_a_texel_is_the_weight_that_directions_give_it(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    environment, directions = random_map(30, 14, torch.float64), everywhere(20, 30, torch.float64)
    environment(directions).sum().backward()
    gradient = environment.features.grad
    # Weights of a lookup add up to one, and a linear function is its gradient times its argument.
    torch.testing.assert_close(gradient[..., 0].sum(), torch.tensor(600.0, dtype=torch.float64))
    total = environment(directions).detach().sum()
    torch.testing.assert_close((gradient * environment.features.detach()).sum(), total)


@BACKENDS
def test_only_wanted_gradients_are_computed(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    environment, directions = random_map(30, 14, torch.float32), everywhere(4, 5, torch.float32)
    environment.features.requires_grad_(False)
    assert not environment(directions).requires_grad
    directions.requires_grad_()
    environment(directions).sum().backward()
    assert environment.features.grad is None
    assert directions.grad.abs().sum() > 0


@BACKENDS
def test_no_directions_find_nothing_and_give_no_gradient(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    environment = random_map(30, 14, torch.float32)
    found = environment(torch.zeros(0, 5, 3))
    assert found.shape == (0, 5, 6)
    found.sum().backward()
    assert not environment.features.grad.any()


@needs_native
def test_threads_do_not_change_a_bit():
    environment, directions = random_map(100, 40, torch.float32), everywhere(150, 150, torch.float32)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(looked_up(environment, directions))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
