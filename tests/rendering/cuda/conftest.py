"""Run these tests under Triton's interpreter; the variable must be set before Triton is imported."""

import os

import pytest

os.environ["TRITON_INTERPRET"] = "1"


@pytest.fixture(autouse=True)
def _interpreter(triton_interpreter: None) -> None:
    pass
