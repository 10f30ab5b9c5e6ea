"""Shape annotations are enforced in every test; tests of the splatter run on each of its backends.

`pytest --require cpu` fails instead of skipping where that backend is missing.
"""

import pytest
from jaxtyping import install_import_hook

install_import_hook("catacaustics", "beartype.beartype")

BACKENDS = ("reference", "cpu")


def _problem(backend: str) -> str:
    from catacaustics.splatting import native

    return "" if backend == "reference" else native.find_library().problem


def pytest_addoption(parser):
    parser.addoption("--require", action="append", default=[], choices=BACKENDS, help="backend that must be tested")


def pytest_report_header():
    return [f"splatter {name}: {_problem(name) or 'tested'}" for name in BACKENDS]


@pytest.fixture(params=BACKENDS)
def backend(request, monkeypatch):
    """Splats with each backend in turn; returns its name."""
    problem = _problem(request.param)
    if problem and request.param in request.config.getoption("--require"):
        pytest.fail(f"no {request.param} backend: {problem}")
    if problem:
        pytest.skip(f"no {request.param} backend: {problem}")
    monkeypatch.setenv("CATACAUSTICS_SPLATTER", request.param)
    return request.param
