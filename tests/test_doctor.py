"""The report on what is installed."""

import pytest
from splatter import needs_native

from catacaustics import kernels
from catacaustics.config import DoctorConfig
from catacaustics.doctor import doctor
from catacaustics.kernels import Found, NativeLibrary, find_library


@pytest.fixture
def report(capsys):
    """What doctor says of each thing that it looks at."""

    def read() -> dict[str, str]:
        doctor(DoctorConfig())
        return {line[:30].strip(): line[30:].strip() for line in capsys.readouterr().out.splitlines()}

    return read


@pytest.mark.parametrize("backend", ["reference", "cpu", "cuda"])
def test_doctor_tests_each_backend_of_the_splatter_or_says_why_there_is_none(report, backend):
    library, problem = (True, "") if backend == "reference" else find_library(backend)
    said = report()[f"splatter: {backend}"]
    assert said.startswith("ok (" if library else f"not available: {problem}")
    assert problem in said


@needs_native
def test_doctor_notices_a_library_whose_gradients_are_wrong(report, monkeypatch):
    class Wrong(NativeLibrary):
        def call(self, name, like, *arguments, **settings):
            result = super().call(name, like, *arguments, **settings)
            if name == "project_backward":
                arguments[-5].mul_(1.001)  # positions
            return result

    whole = find_library("cpu").library
    found = {"cpu": Found(Wrong(*whole), ""), "cuda": Found(None, "left out")}
    monkeypatch.setattr(kernels, "find_library", found.__getitem__)
    assert "FAILED" in (said := report()["splatter: cpu"])
    assert "the gradient of positions is off by 1.0e-03 of its largest value" in said
