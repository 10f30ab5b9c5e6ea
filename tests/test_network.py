"""The neural renderer in native code: what PyTorch computes, image and every gradient."""

import pytest
import torch

from catacaustics.kernels import find_library, host_kernel
from catacaustics.renderer import FEATURES, NeuralRenderer
from catacaustics.renderer_native import decode

pytestmark = pytest.mark.skipif(
    host_kernel("network", torch.zeros(1)) is None, reason=f"no native renderer: {find_library('cpu').problem}"
)

CHANNELS = (FEATURES, FEATURES, 3)
NAMES = ("primary", "reflection", "directions")


def renderer_of(width: int, layers: int, dtype: torch.dtype = torch.float64) -> NeuralRenderer:
    """With values of the size that training gives, none of which is zero."""
    torch.manual_seed(width + layers)
    renderer = NeuralRenderer(width, layers).to(dtype)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.5 * width**-0.5)
    return renderer


def images_of(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(*shape, c, dtype=torch.float64, generator=generator).to(dtype) for c in CHANNELS]


def results(monkeypatch, backend: str, renderer: NeuralRenderer, images: list[torch.Tensor]) -> dict[str, torch.Tensor]:
    """Image and every gradient of a weighted sum, by name, in float64."""
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    images = [t.detach().requires_grad_() for t in images]
    renderer.zero_grad()
    rgb = renderer(*images)
    assert (type(rgb.grad_fn).__name__ == "_DecodeBackward") == (backend == "cpu")  # each takes the path it should
    weights = torch.randn(rgb.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (rgb.double() * weights).sum().backward()
    named = {"image": rgb, **{n: t.grad for n, t in zip(NAMES, images, strict=True)}}
    named |= {n: p.grad for n, p in renderer.named_parameters()}
    return {name: t.detach().double() for name, t in named.items()}


def assert_close(got: dict[str, torch.Tensor], want: dict[str, torch.Tensor], tolerance: float) -> None:
    """Differences as a share of each image's norm, and those of parameters as a share of the norm of all together."""
    assert got.keys() == want.keys()
    together = float(torch.stack([t.norm() for name, t in want.items() if "." in name] or [torch.zeros(())]).norm())
    for name, expected in want.items():
        assert got[name].shape == expected.shape, name
        error, norm = float((got[name] - expected).norm()), together if "." in name else float(expected.norm())
        assert error <= tolerance * norm, f"{name}: off by {error:.1e} of {norm:.1e}"


SIZES = pytest.mark.parametrize(
    ("width", "layers"), [(16, 1), (16, 9), (20, 3), (32, 1), (32, 5), (48, 3), (64, 5), (64, 9), (1, 3), (100, 3)]
)


@SIZES
@pytest.mark.parametrize("pixels", [(0, 4), (1, 1), (1, 7), (3, 43), (33, 67)], ids=str)
def test_image_and_gradients_are_those_of_pytorch(monkeypatch, width, layers, pixels):
    renderer, images = renderer_of(width, layers), images_of(*pixels)
    want = results(monkeypatch, "reference", renderer, images)
    assert_close(results(monkeypatch, "cpu", renderer, images), want, 1e-12)


def test_so_are_those_of_a_training_step(monkeypatch):
    renderer, images = renderer_of(32, 5), images_of(150, 150)
    want = results(monkeypatch, "reference", renderer, images)
    assert_close(results(monkeypatch, "cpu", renderer, images), want, 1e-12)


@SIZES
def test_rounding_in_float32_costs_little(monkeypatch, width, layers):
    """Of features that keep ReLUs away from where rounding decides whether they pass."""
    renderer = renderer_of(width, layers).float()
    images = images_of(9, 77, dtype=torch.float32)
    got = results(monkeypatch, "cpu", renderer, images)
    want = results(monkeypatch, "reference", renderer.double(), [t.double() for t in images])
    assert_close(got, want, 1e-5)


def test_images_need_not_be_contiguous(monkeypatch):
    renderer, images = renderer_of(32, 5), images_of(13, 11)
    strided = [torch.cat([t, t], 2)[..., : t.shape[2]].transpose(0, 1) for t in images]
    assert not any(t.is_contiguous() for t in strided)
    want = results(monkeypatch, "reference", renderer, strided)
    assert_close(results(monkeypatch, "cpu", renderer, strided), want, 1e-12)
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu")
    rgb = renderer(*strided)
    expanded = torch.ones(1, 1, 1, dtype=rgb.dtype).expand_as(rgb)
    assert torch.equal(
        *(torch.autograd.grad(rgb, renderer.head.weight, g, retain_graph=True)[0] for g in (expanded, expanded.clone()))
    )


@pytest.mark.parametrize(("width", "layers"), [(5, 1), (4, 3), (3, 5)])
def test_gradients_are_those_of_finite_differences(width, layers):
    renderer, images = renderer_of(width, layers), images_of(2, 3, seed=3)
    inputs = [t.detach().requires_grad_() for t in (*images, *renderer.parameters())]
    assert decode(*inputs[:3], inputs[3:]) is not None
    assert torch.autograd.gradcheck(lambda *t: decode(*t[:3], t[3:]), inputs, eps=1e-6, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_results_do_not_depend_on_the_number_of_threads(monkeypatch, dtype):
    renderer, images = renderer_of(32, 5, dtype), images_of(97, 101, dtype=dtype)
    before, seen = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            seen.append(results(monkeypatch, "cpu", renderer, images))
    finally:
        torch.set_num_threads(before)
    for name, value in seen[0].items():
        assert torch.equal(value, seen[1][name]), name
        assert torch.equal(value, seen[2][name]), name


def test_frozen_parameters_and_inputs_get_no_gradients_and_the_others_the_same(monkeypatch):
    renderer, images = renderer_of(32, 5), images_of(20, 30)
    want = results(monkeypatch, "cpu", renderer, images)
    features = [t.detach().requires_grad_(i < 2) for i, t in enumerate(images)]
    weights = torch.randn(20, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    renderer.zero_grad()
    renderer.requires_grad_(False)
    renderer(*features).backward(weights)
    assert features[2].grad is None
    assert all(p.grad is None for p in renderer.parameters())
    assert_close({n: features[i].grad for i, n in enumerate(NAMES[:2])}, {n: want[n] for n in NAMES[:2]}, 1e-15)

    renderer.head.requires_grad_(True)
    renderer(*images).backward(weights)
    got = {n: p.grad for n, p in renderer.named_parameters() if p.grad is not None}
    assert_close(got, {n: want[n] for n in ("head.weight", "head.bias")}, 1e-15)


def test_without_gradients_the_image_is_the_same_and_keeps_nothing(monkeypatch):
    renderer, images = renderer_of(32, 5, torch.float32), images_of(48, 50, dtype=torch.float32)
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu")
    with_gradients = renderer(*images)
    with torch.no_grad():
        rgb = renderer(*images)
    assert rgb.grad_fn is None
    assert torch.equal(rgb, with_gradients)


@pytest.mark.parametrize("width", [32, 20])
@pytest.mark.parametrize("spoilt", range(3))
def test_what_is_not_a_number_spoils_its_pixel_and_no_other(monkeypatch, width, spoilt):
    renderer, images = renderer_of(width, 3), images_of(10, 20)
    clean = results(monkeypatch, "cpu", renderer, images)
    images[spoilt][4, 7, -1] = torch.nan
    got = results(monkeypatch, "cpu", renderer, images)
    want = results(monkeypatch, "reference", renderer, images)
    for name, value in got.items():
        assert torch.equal(value.isnan(), want[name].isnan()), name
    assert got["image"][4, 7].isnan().all()
    assert got["decoder.input.weight"].isnan().any()
    others = torch.ones(10, 20, dtype=torch.bool)
    others[4, 7] = False
    for name in ("image", *NAMES):
        assert torch.equal(got[name][others], clean[name][others]), name


def test_a_parameter_that_is_not_a_number_spoils_all(monkeypatch):
    renderer, images = renderer_of(32, 5), images_of(10, 20)
    with torch.no_grad():
        renderer.decoder.input.bias[0] = torch.nan
    assert results(monkeypatch, "cpu", renderer, images)["image"].isnan().all()


def test_an_infinite_feature_gives_what_it_gives_in_pytorch(monkeypatch):
    renderer, images = renderer_of(20, 3), images_of(10, 20)
    images[0][4, 7, 5], images[1][2, 3, 4] = torch.inf, -torch.inf
    rgb = []
    for backend in ("cpu", "reference"):
        monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
        rgb.append(renderer(*images).detach())
    torch.testing.assert_close(*rgb, rtol=1e-12, atol=1e-12, equal_nan=True)
    assert rgb[0][0].isfinite().all()


def test_gradients_at_the_kink_of_a_relu_are_zero(monkeypatch):
    renderer, images = renderer_of(16, 3), images_of(5, 5)
    with torch.no_grad():
        renderer.reflection_encoder.input.weight.zero_()
        renderer.reflection_encoder.input.bias.zero_()
    got = results(monkeypatch, "cpu", renderer, images)
    assert got["reflection_encoder.input.bias"].eq(0).all()
    assert got["primary_encoder.input.bias"].ne(0).any()


def test_types_that_differ_are_left_to_pytorch():
    renderer, images = renderer_of(16, 3, torch.float32), images_of(5, 5)
    assert decode(*images, list(renderer.parameters())) is None
    assert decode(*(t.half() for t in images), list(renderer.half().parameters())) is None
