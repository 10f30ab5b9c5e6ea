"""Adam that leaves rows without a gradient alone: in PyTorch, in native code, and one against the other."""

import pytest
import torch
from splatter import needs_native

from catacaustics.training import optimizer as optimizer_module
from catacaustics.training.optimizer import RowAdam

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
BACKENDS = pytest.mark.parametrize("backend", ["reference", pytest.param("cpu", marks=needs_native)])


def adam(start, rows, row_rates=None, **settings):
    """An optimizer of one parameter that starts at `start`, and the parameter."""
    parameter = torch.nn.Parameter(start.clone())
    group = {"params": [parameter], "name": "some", "rows": rows, "row_rates": row_rates, "lr": 0.1}
    return RowAdam([group | {"weight_decay": 0.0} | settings]), parameter


def sparse_gradient(shape, rows, dtype, generator, share=0.3):
    """Random numbers, zero in most rows."""
    gradient = torch.randn(shape, generator=generator, dtype=dtype)
    seen = torch.rand(shape[:rows], generator=generator) < share
    return gradient * seen.view(*seen.shape, *[1] * (len(shape) - rows))


def trained(start, gradients, rows, **settings):
    """The parameter and its state after a step on each gradient."""
    optimizer, parameter = adam(start, rows, **settings)
    for gradient in gradients:
        parameter.grad = gradient.clone()
        optimizer.step()
    return {"value": parameter.detach(), **optimizer.state[parameter]}


@needs_native
@DTYPES
@pytest.mark.parametrize(
    ("shape", "rows"),
    [((9001,), 1), ((4099, 3), 1), ((5000, 6), 1), ((33, 5, 2), 1), ((40, 90, 6), 2), ((77, 41), 0), ((3,), 0)],
)
def test_native_steps_agree_with_pytorch(monkeypatch, shape, rows, dtype):
    rng = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=rng, dtype=dtype)
    gradients = [sparse_gradient(shape, rows or 1, dtype, rng) for _ in range(12)]
    rates = torch.rand(shape[0], generator=rng, dtype=dtype) if rows == 1 else None
    settings = {"row_rates": rates, "weight_decay": 0.1}
    native = trained(start, gradients, rows, **settings)
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "reference")
    torch_only = trained(start, gradients, rows, **settings)
    tolerance = {"rtol": 2e-5, "atol": 1e-6} if dtype == torch.float32 else {"rtol": 1e-11, "atol": 1e-13}
    for name, expected in torch_only.items():
        torch.testing.assert_close(native[name], expected, **tolerance, msg=lambda text, name=name: f"{name}: {text}")
    assert torch.equal(native["step"], torch_only["step"])


@needs_native
def test_native_code_takes_the_step_where_there_is_some(monkeypatch):
    def refused(*_):
        raise AssertionError("computed in PyTorch")

    monkeypatch.setattr(optimizer_module, "_adam", refused)
    for rows in (0, 1):
        trained(torch.ones(5, 3), [torch.ones(5, 3)], rows)


@BACKENDS
@DTYPES
@pytest.mark.parametrize("rows", [0, 1])
def test_the_first_step_moves_by_the_learning_rate_against_the_gradients_sign(monkeypatch, backend, dtype, rows):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    gradient = torch.tensor([[3.0, -1e-4], [1e6, -2.0]], dtype=dtype).repeat(20, 1)
    value = trained(torch.zeros(40, 2, dtype=dtype), [gradient], rows)["value"]
    torch.testing.assert_close(value, -0.1 * gradient.sign(), rtol=1e-6, atol=0)


@BACKENDS
def test_rows_without_a_gradient_keep_value_moments_and_count_bit_for_bit(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    rng = torch.Generator().manual_seed(1)
    optimizer, parameter = adam(torch.randn(5000, 3, generator=rng), 1, weight_decay=0.5)
    parameter.grad = torch.randn(5000, 3, generator=rng)
    optimizer.step()
    state = optimizer.state[parameter]
    before = [t.detach().clone() for t in (parameter, *state.values())]
    parameter.grad = sparse_gradient((5000, 3), 1, torch.float32, rng)
    parameter.grad[7] = -0.0
    optimizer.step()
    seen = parameter.grad.any(1)
    assert 0 < seen.sum() < 5000
    for old, new in zip(before, (parameter.detach(), *state.values()), strict=True):
        assert torch.equal(old[~seen], new[~seen])
        assert not (old[seen] == new[seen]).all()


@BACKENDS
def test_a_row_counts_its_own_steps_up_to_hundreds_of_thousands(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    counts = torch.tensor([0.0, 1, 9, 254, 255, 256, 999, 65534, 65535, 65536, 400_000])
    optimizer, parameter = adam(torch.zeros(len(counts), dtype=torch.float64), 1)
    zeros = torch.zeros_like(parameter)
    optimizer.state[parameter] = {"step": counts.clone(), "exp_avg": zeros.clone(), "exp_avg_sq": zeros.clone()}
    parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    taken = (counts + 1).double()
    expected = -0.1 * (0.1 / (1 - 0.9**taken)) / (0.001 / (1 - 0.999**taken)).sqrt()
    torch.testing.assert_close(parameter.detach(), expected, rtol=1e-11, atol=0)
    assert torch.equal(optimizer.state[parameter]["step"], counts + 1)


@BACKENDS
def test_a_gradient_that_is_not_a_number_spoils_its_own_row_alone(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    gradient = torch.zeros(40, 3)
    gradient[4, 1], gradient[9, 0], gradient[20] = float("nan"), float("inf"), 1.0
    value = trained(torch.ones(40, 3), [gradient], 1)["value"]
    spoiled = torch.zeros(40, 3, dtype=torch.bool)
    spoiled[4, 1] = spoiled[9, 0] = True
    assert torch.equal(value.isnan(), spoiled)
    assert torch.equal(value[0], torch.ones(3))
    assert (value[20] < 1).all()


@BACKENDS
def test_denormal_gradients_count_as_a_step(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    gradient = torch.zeros(100, 3)
    gradient[50, 2] = 1e-42
    state = trained(torch.ones(100, 3), [gradient], 1, weight_decay=0.5)
    assert state["step"].nonzero().tolist() == [[50]]
    torch.testing.assert_close(state["value"][50], torch.full((3,), 0.95), rtol=1e-6, atol=0)


@BACKENDS
@pytest.mark.parametrize("rows", [0, 1])
def test_parameters_without_elements_take_steps(monkeypatch, backend, rows):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    assert trained(torch.zeros(0, 3), [torch.zeros(0, 3)] * 2, rows)["value"].shape == (0, 3)


@needs_native
@pytest.mark.parametrize("rows", [0, 1])
def test_threads_do_not_change_a_bit(rows):
    rng = torch.Generator().manual_seed(2)
    start = torch.randn(20_001, 3, generator=rng)
    gradients = [sparse_gradient((20_001, 3), 1, torch.float32, rng) for _ in range(3)]
    threads, states = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            states.append(trained(start, gradients, rows))
    finally:
        torch.set_num_threads(threads)
    for state in states[1:]:
        assert all(torch.equal(state[name], value) for name, value in states[0].items())


@pytest.mark.parametrize("rows", [0, 1])
def test_gradients_that_are_not_contiguous_take_the_same_step(rows):
    rng = torch.Generator().manual_seed(3)
    start, gradient = torch.randn(30, 4, generator=rng), torch.randn(4, 30, generator=rng)
    gradient[:, 5] = 0
    optimizer, parameter = adam(start, rows)
    parameter.grad = gradient.T
    assert not parameter.grad.is_contiguous()
    optimizer.step()
    expected = trained(start, [gradient.T.contiguous()], rows)
    torch.testing.assert_close(parameter.detach(), expected["value"], rtol=1e-6, atol=1e-7)
