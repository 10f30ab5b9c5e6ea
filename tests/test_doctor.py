"""The report on what is installed."""

import pytest

from catacaustics.config import DoctorConfig
from catacaustics.doctor import doctor
from catacaustics.kernels import find_library


@pytest.fixture
def report(capsys):
    doctor(DoctorConfig())
    return {line[:30].strip(): line[30:].strip() for line in capsys.readouterr().out.splitlines()}


@pytest.mark.parametrize("backend", ["reference", "cpu", "cuda"])
def test_doctor_tests_each_backend_of_the_splatter_or_says_why_there_is_none(report, backend):
    said = next(value for name, value in report.items() if name.startswith(f"splatter: {backend}"))
    library, problem = (True, "") if backend == "reference" else find_library(backend)
    assert said.startswith("ok (" if library else f"not available: {problem}")
