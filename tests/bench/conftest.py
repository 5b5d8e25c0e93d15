"""Fixtures of the benchmark tests."""

import pytest

from pansplat.bench import roofline


@pytest.fixture
def fast_peaks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the machine's peaks in milliseconds."""
    monkeypatch.setattr(roofline, "_STEPS", 1 << 12)
    monkeypatch.setattr(roofline, "_ELEMENTS", 1 << 12)
