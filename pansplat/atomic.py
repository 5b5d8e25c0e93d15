"""Atomic writing: a file appears complete or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pansplat.errors import InputError


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` when the block succeeds.

    The temporary file lies in the same folder and has the same suffix. If the block raises, it is removed and `path`
    stays unchanged.

    Raises:
        InputError: the folder of `path` does not exist or cannot be written.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: needed an existing folder, got {path.parent}; create it first")
    if path.is_dir():
        raise InputError(f"cannot write {path}: needed a file name, got a folder; give a file inside it")
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: needed a writable folder with free disk space, got "
            f"'{error.strerror or error}'; choose another folder"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
