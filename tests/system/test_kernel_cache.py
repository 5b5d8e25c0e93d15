"""Numba has a writable cache folder wherever the package is installed."""

from pathlib import Path

import pytest

from pansplat.system.kernel_cache import choose_kernel_cache

UNWRITABLE = "/proc/pansplat"  # also for the superuser


def test_writable_folders_are_left_to_numba(tmp_path: Path) -> None:
    for package, cache in ((str(tmp_path), UNWRITABLE), (UNWRITABLE, str(tmp_path))):
        environment = {"HOME": "/nowhere", "XDG_CACHE_HOME": cache}
        choose_kernel_cache(package, environment)
        assert "NUMBA_CACHE_DIR" not in environment


def test_without_a_writable_folder_a_private_one_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    environment = {"XDG_CACHE_HOME": UNWRITABLE}
    choose_kernel_cache(UNWRITABLE, environment)
    folder = Path(environment["NUMBA_CACHE_DIR"])
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o077 == 0


def test_the_users_choice_is_kept() -> None:
    environment = {"NUMBA_CACHE_DIR": "mine", "XDG_CACHE_HOME": UNWRITABLE}
    choose_kernel_cache(UNWRITABLE, environment)
    assert environment["NUMBA_CACHE_DIR"] == "mine"
