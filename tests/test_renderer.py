"""Renderer, environment map, warps and losses: known answers."""

import math

import numpy as np
import pytest
import torch

from catacaustics.environment import EnvironmentMap
from catacaustics.losses import coverage_loss, dssim, ssim_map, total_variation, weight_loss
from catacaustics.reflectors.warps import NeuralWarp, StaticWarp
from catacaustics.renderer import FEATURES, NeuralRenderer, ResidualMLP


def test_an_untrained_renderer_shows_the_colours_of_the_clouds():
    primary, reflection = torch.rand(4, 5, FEATURES), torch.rand(4, 5, FEATURES)
    directions = torch.nn.functional.normalize(torch.randn(4, 5, 3), dim=-1)
    rgb = NeuralRenderer()(primary, reflection, directions)
    torch.testing.assert_close(rgb, primary[..., :3] + reflection[..., :3])


def test_the_renderer_has_nine_layers_and_every_parameter_learns():
    renderer = NeuralRenderer()
    for part in (renderer.primary_encoder, renderer.reflection_encoder, renderer.decoder):
        assert sum(isinstance(m, torch.nn.Linear) for m in part.modules()) == 9
    optimizer = torch.optim.Adam(renderer.parameters(), 1e-2)
    before = {n: p.detach().clone() for n, p in renderer.named_parameters()}
    inputs = torch.rand(64, 1, FEATURES), torch.rand(64, 1, FEATURES), torch.rand(64, 1, 3)
    for _ in range(4):
        optimizer.zero_grad()
        ((renderer(*inputs) - inputs[1][..., 3:]) ** 2).mean().backward()
        optimizer.step()
    for name, parameter in renderer.named_parameters():
        assert not torch.equal(parameter, before[name]), name


def test_a_fixup_network_starts_as_its_first_layer_whatever_its_depth():
    x = torch.randn(7, 5)
    network = ResidualMLP(5, 16, 9)
    torch.testing.assert_close(network(x), torch.relu(network.input(x)))


def direction(longitude, latitude):
    return torch.tensor(
        [
            math.cos(latitude) * math.sin(longitude),
            math.sin(latitude),
            math.cos(latitude) * math.cos(longitude),
        ]
    )[None, None]


def test_the_environment_map_returns_what_is_stored_in_a_direction():
    environment = EnvironmentMap(16, 8)
    with torch.no_grad():
        environment.features.copy_(torch.randn_like(environment.features))
    for row, column in ((0, 0), (3, 7), (7, 15), (4, 8)):
        longitude = (column + 0.5) / 16 * 2 * math.pi - math.pi
        latitude = (row + 0.5) / 8 * math.pi - math.pi / 2
        found = environment(direction(longitude, latitude))[0, 0]
        torch.testing.assert_close(found, environment.features[row, column], atol=2e-5, rtol=1e-5)


def test_the_poles_of_the_environment_map_are_where_up_and_down_are():
    up = torch.tensor([0.6, 0.0, 0.8])
    environment = EnvironmentMap(16, 8, up)
    with torch.no_grad():
        environment.features.copy_(torch.arange(8.0)[:, None, None].expand(8, 16, 6))
    level = torch.tensor([0.8, 0.0, -0.6])
    for direction_, row in ((up, 0.0), (-up, 7.0), (level, 3.5), (torch.tensor([0.0, 1.0, 0.0]), 3.5)):
        torch.testing.assert_close(environment(direction_[None, None])[0, 0], torch.full((6,), row), atol=1e-4, rtol=0)
    torch.testing.assert_close(environment.axes @ environment.axes.T, torch.eye(3))
    torch.testing.assert_close(torch.linalg.det(environment.axes), torch.tensor(1.0))


def test_the_environment_map_has_no_seam():
    environment = EnvironmentMap(16, 8)
    with torch.no_grad():
        environment.features.copy_(torch.randn_like(environment.features))
    left, right = (environment(direction(s * (math.pi - 1e-5), 0.2)) for s in (-1, 1))
    torch.testing.assert_close(left, right, atol=1e-3, rtol=0)
    between = (environment.features[:, 0] + environment.features[:, -1]) / 2
    latitude = 0.5 / 8 * math.pi
    torch.testing.assert_close(environment(direction(math.pi, latitude))[0, 0], between[4], atol=2e-5, rtol=1e-5)


def test_a_static_warp_moves_nothing_and_a_neural_warp_starts_almost_still():
    positions = torch.rand(50, 3)
    warp = NeuralWarp(torch.zeros(3), torch.tensor([4.0, 1.0, 2.0]))
    center = torch.tensor([3.0, 0.5, 1.0])
    assert torch.equal(StaticWarp()(positions, center).positions, positions)
    motion = (warp(positions, center).positions - positions).detach().norm(dim=1)
    assert 0 < float(motion.max()) < 0.02 * 2.0  # half the longest side is 2


def test_a_neural_warp_is_the_same_in_other_units_of_length():
    """Normalisation to [-1, 1]: a scene ten times as large moves ten times as far."""
    torch.manual_seed(0)
    small = NeuralWarp(torch.zeros(3), torch.ones(3))
    large = NeuralWarp(torch.zeros(3), 10 * torch.ones(3))
    large.network.load_state_dict(small.network.state_dict())
    p, c = torch.rand(20, 3), torch.rand(3)
    torch.testing.assert_close(large(10 * p, 10 * c).positions, 10 * small(p, c).positions, rtol=1e-5, atol=1e-5)


def test_ssim_of_an_image_with_itself_is_one_and_it_agrees_with_torchmetrics():
    from torchmetrics.functional.image import structural_similarity_index_measure

    rng = np.random.default_rng(0)
    a = torch.from_numpy(rng.random((24, 31, 3)))
    b = (a + 0.1 * torch.from_numpy(rng.standard_normal((24, 31, 3)))).clamp(0, 1)
    torch.testing.assert_close(ssim_map(a, a), torch.ones(14, 21, 3, dtype=a.dtype))
    theirs = structural_similarity_index_measure(
        a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None], data_range=1.0, return_full_image=True
    )
    full = theirs[1][0].permute(1, 2, 0)[5:-5, 5:-5]
    torch.testing.assert_close(ssim_map(a, b), full, atol=1e-9, rtol=1e-7)
    assert float(dssim(a, a)) == pytest.approx(0, abs=1e-12)


def test_dssim_of_an_image_smaller_than_its_window_is_finite():
    a, b = torch.rand(3, 5, 3), torch.rand(3, 5, 3)
    assert 0 < float(dssim(a, b)) <= 1


def test_the_coverage_loss_fills_the_volume_and_ignores_the_rest():
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[1:3, 1:3] = True
    through = torch.full((4, 4), 0.5, requires_grad=True)
    loss = coverage_loss(through, mask)
    assert loss.item() == 0.5
    (gradient,) = torch.autograd.grad(loss, through)
    assert torch.equal(gradient, mask * 0.25)  # descending it lowers the transmittance inside, nothing outside
    assert coverage_loss(through, torch.zeros_like(mask)).item() == 0


def test_the_weight_loss_pulls_rho_to_the_mask_and_variation_counts_edges():
    mask = torch.tensor([[True, False]])
    assert weight_loss(torch.tensor([[0.75, 0.5]]), mask).item() == 0.375
    assert total_variation(torch.tensor([[0.0, 1.0], [0.0, 1.0]])).item() == 1.0
    assert total_variation(torch.tensor([[0.3]])).item() == 0
