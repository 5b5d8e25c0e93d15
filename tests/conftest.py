"""Fixtures every test may use."""

import os
from pathlib import Path

import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The ../shared folder of fixtures and data: must be there in CI, skips the test on a bare clone."""
    if not _SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail("CI needs ../shared beside the checkout")
        pytest.skip("needs the ../shared folder beside the checkout")
    return _SHARED
