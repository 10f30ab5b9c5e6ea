"""Shape annotations are enforced in every test; tests of the splatter run on each of its backends.

`pytest --require cpu` fails instead of skipping where that backend is missing; `emulated` is the GPU's code on a CPU.
"""

import pytest
from jaxtyping import install_import_hook

from catacaustics.threads import rest_between_loops

rest_between_loops()

install_import_hook("catacaustics", "beartype.beartype")

import splatter  # noqa: E402
from toy import make_toy_capture  # noqa: E402

from catacaustics import kernels  # noqa: E402
from catacaustics.capture.dataset import open_capture  # noqa: E402


def pytest_addoption(parser):
    parser.addoption(
        "--require", action="append", default=[], choices=splatter.BACKENDS, help="backend that must be tested"
    )


def pytest_report_header():
    shown = [name for name in splatter.BACKENDS if name != "emulated"]  # which takes seconds to build
    return [f"splatter {name}: {splatter.problem(name) or 'tested'}" for name in shown]


def pytest_terminal_summary(terminalreporter):
    if splatter.errors:
        terminalreporter.section("splatter: largest errors against the reference in float64, shares of largest values")
    for (backend, dtype, case), seen in sorted(splatter.errors.items()):
        if (backend, dtype) == ("reference", "float64") and not any(seen.values()):
            continue  # compared with itself
        gradients = {name: error for name, error in seen.items() if name not in ("image", "transmittance")}
        worst = max(gradients, key=gradients.__getitem__, default="")
        figures = [f"{name} {seen[name]:.0e}" for name in ("image", "transmittance") if name in seen]
        figures += [f"gradients {gradients[worst]:.0e} ({worst})"] if gradients else []
        terminalreporter.write_line(f"{backend:9} {dtype:7} {case:38} {'  '.join(figures)}")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The toy capture, with masks and points."""
    return open_capture(make_toy_capture(tmp_path_factory.mktemp("capture")))


@pytest.fixture(params=splatter.BACKENDS)
def backend(request, monkeypatch):
    """Splats with each backend in turn; returns its name."""
    name, problem = request.param, splatter.problem(request.param)
    if problem and name in request.config.getoption("--require"):
        pytest.fail(f"no {name} backend: {problem}")
    if problem:
        pytest.skip(f"no {name} backend: {problem}")
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu" if name == "emulated" else name)
    monkeypatch.setattr(splatter.device, "backend", name)
    if name == "cuda":
        monkeypatch.setattr(splatter.device, "name", "cuda")
    if name == "emulated":
        monkeypatch.setattr(kernels, "find_library", lambda _: splatter.emulated_library())
    return name
