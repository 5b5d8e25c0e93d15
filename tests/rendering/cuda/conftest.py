"""Everything here runs under Triton's interpreter, chosen before anything can import Triton."""

import os

import pytest

os.environ["TRITON_INTERPRET"] = "1"


@pytest.fixture(autouse=True)
def _interpreter(triton_interpreter: None) -> None:
    pass
