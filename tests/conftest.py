"""Fixtures every test may use."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from jaxtyping import config, install_import_hook

import pansplat.testing  # noqa: F401  # the hook names it

# Annotated shapes and types are checked at every call; the hook must come before the rooms are imported.
_CHECKED = ("geometry", "gaussians", "render", "evaluation", "pipeline")
install_import_hook([f"pansplat.{room}" for room in _CHECKED], "pansplat.testing.check_types")

_SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The ../shared folder of fixtures and data: must be there in CI, skips the test on a bare clone."""
    if not _SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail("CI needs ../shared beside the checkout")
        pytest.skip("needs the ../shared folder beside the checkout")
    return _SHARED


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the run-time checks of annotations, as users run: for tests of what they are told."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
