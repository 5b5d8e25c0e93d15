"""Atomic writing: a file appears complete or not at all."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pansplat.errors import InputError
from pansplat.system.files import describe_kind

_MAX_STEM = 48  # characters of the name that the temporary name repeats
_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}(\.\w+)?")


@contextmanager
def replacing(path: Path | str, *, failures: tuple[type[Exception], ...] = ()) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` when the block succeeds.

    The temporary file lies in the same folder and has the same suffix. If the block raises, it is removed and `path`
    stays unchanged.

    Args:
        path: the file to write. A symbolic link to a file stays; one to nothing would choose where to write.
        failures: further exceptions of a library that mean a failed write, such as a full disk.
    """
    path = Path(path)
    if path.is_symlink() and path.exists():
        path = Path(os.path.realpath(path))
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: needed an existing folder, got {path.parent}; create it first")
    if path.is_dir():
        raise InputError(f"cannot write {path}: needed a file name, got a folder; give a file inside it")
    if path.exists() and (kind := describe_kind(path)):
        raise InputError(f"cannot write {path}: needed a file name, got {kind}; give another name")
    temporary = path.with_name(f".{path.stem[:_MAX_STEM]}.{secrets.token_hex(4)}{path.suffix}")
    try:
        with _naming(path, (OSError, *failures)):
            yield temporary
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `folder`, which gets its name when the block succeeds.

    Args:
        folder: does not exist, or is empty; its parents are made.
    """
    folder = Path(os.path.abspath(folder))
    temporary = folder.with_name(f".{folder.name[:_MAX_STEM]}.{secrets.token_hex(4)}")
    try:
        with _naming(folder, (OSError,)):
            temporary.mkdir(parents=True)
            yield temporary
            if folder.is_dir():
                folder.rmdir()
            os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _naming(path: Path, failures: tuple[type[Exception], ...]) -> Iterator[None]:
    """Raise an InputError that names the path in place of a failed write."""
    try:
        yield
    except InputError:
        raise
    except failures as error:
        reason = getattr(error, "strerror", None) or (str(error) or repr(error)).splitlines()[0]
        raise InputError(
            f"cannot write {path}: needed a writable folder with free disk space, got '{reason}'; choose another folder"
        ) from error


def is_unfinished(path: Path) -> bool:
    """Whether a file has a temporary name of `replacing`."""
    return _TEMPORARY.fullmatch(path.name) is not None
