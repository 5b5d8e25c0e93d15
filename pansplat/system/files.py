"""Checks of the files and folders that a user names, before anything is read, computed or written.

The argument `option` is the option that error messages name, such as "--out"; `needed` what was needed.
"""

from __future__ import annotations

import errno
import itertools
import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path

from pansplat.errors import InputError

# Suffixes of scene files; the first that fits a name is its format (pansplat.gaussians.formats).
SCENE_SUFFIXES = (".compressed.ply", ".spz", ".splat", ".sog", ".glb", ".ply")

PLY_TYPES = {  # numpy's codes of the types in headers of .ply files
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

SOFTWARE = "software: pansplat"  # comment in every written file whose format has a place for one

# The forms of SOFTWARE: in pictures, JSON and pages; in scene files; in an entry of a zip; in files of weights.
_WRITTEN = re.compile(
    rb'(software|generator)\W{1,5}(content\W{1,3})?pansplat|pansplat \{"version"|PK\x01\x02.{42}pansplat\.json'
    rb'|"pansplat_format"',
    re.IGNORECASE | re.DOTALL,
)
_SEARCHED_BYTES = 1 << 16  # the start and the end of a file, where SOFTWARE is searched for

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO (named pipe)"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


# Windows opens a device for these names, whatever their suffix.
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d) *(\..*)?", re.IGNORECASE)


def require_text(path: Path) -> None:
    """Check that a file's name is text: JSON, comments of scenes and pages cannot hold bytes that are not UTF-8."""
    try:
        path.name.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{str(path)!a}: needed a name in UTF-8, got other bytes; rename the file.") from error


def make_portable_name(name: str) -> str:
    """The name of a scene as that of a file or folder on every system; empty if no letter is left."""
    plain = re.sub(r"[^\w.-]+", "_", name).strip("._")
    return f"_{plain}" if _DEVICE.fullmatch(plain) else plain


def make_unique_name(name: str, taken: Iterable[str]) -> str:
    """The name, with a number if it is taken, also in other capitals: file systems may not distinguish them."""
    folded = {other.lower() for other in taken}
    numbered = (f"{name}_{number}" for number in itertools.count(2))
    return next(text for text in itertools.chain((name,), numbered) if text.lower() not in folded)


def describe_kind(path: Path | str) -> str | None:
    """The kind of a path, such as "a folder" or "a FIFO (named pipe)"; None for a regular file.

    Raises:
        OSError: there is no such path.
    """
    mode = os.stat(path).st_mode
    return next((kind for is_kind, kind in _KINDS if is_kind(mode)), None)


def require_file(path: Path | str, needed: str = "a readable file") -> None:
    """Check that a path is a regular file. Reading a FIFO or a device may never end."""
    try:
        kind = describe_kind(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: needed {needed}, got no such file; check the path.") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: needed {needed}, got '{reason}'; check the path.") from error
    if kind is not None:
        raise InputError(f"{path}: needed {needed}, got {kind}; give a regular file.")


def is_scene_file(path: Path | str) -> bool:
    """Whether the name of a file ends in the suffix of a scene format, in any case."""
    return str(path).lower().endswith(SCENE_SUFFIXES)


def find_scene_suffix(path: Path | str) -> str:
    """The suffix of a scene format in a file's name, in lower case; an InputError without one."""
    for suffix in SCENE_SUFFIXES:
        if str(path).lower().endswith(suffix):
            return suffix
    known = ", ".join(SCENE_SUFFIXES)
    raise InputError(f"{path}: a scene file must end in {known}, got {Path(path).suffix or 'no suffix'!r}")


def read_file(path: Path | str, needed: str = "a readable file", *, limit: int | None = None) -> bytes:
    """Content of a regular file of at most `limit` bytes."""
    require_file(path, needed)
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if limit is not None and size > limit:
                raise InputError(f"{path}: needed {needed} of at most {limit:,} bytes, got {size:,}; check the file.")
            return file.read()
    except OSError as error:
        raise InputError(f"{path}: needed {needed}, got '{error.strerror or error}'; check the path.") from error


def expand_home(path: Path | str) -> Path:
    """The path with `~` replaced by the home folder; an InputError if there is none."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise InputError(f"{path}: needed a home folder for `~`, got none; give the whole path.") from error


def require_output_folder(option: str, folder: Path) -> None:
    """Check that a folder can be written, or made with its parents, before the work. Nothing is made."""
    advice = "choose another folder"
    if reason := _find_system_problem(folder, errno.ENOENT):
        raise InputError(f"{option} {folder}: needed a folder to write into, got '{reason}'; {advice}")
    existing = Path(os.path.abspath(folder))
    while not os.path.lexists(existing):
        if existing == existing.parent:
            raise InputError(f"{option} {folder}: needed an existing drive, got {existing}; {advice}")
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"{option} {folder}: needed a folder to write into, got the file {existing}; {advice}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{option} {folder}: needed a writable folder, got {existing}, which is read-only; {advice}")


def require_new_folder(option: str, folder: Path) -> None:
    """Check that a folder can be made, before the work: it does not exist, or is empty."""
    require_output_folder(option, folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{option} {folder}: needed a new or empty folder, got one with files; choose another name")


def require_output_file(option: str, path: Path, suffixes: tuple[str, ...] = (), overwrite: bool | None = True) -> None:
    """Check that a file can be written, before the work.

    Args:
        path: the file; its folder must exist.
        suffixes: the allowed suffixes in lower case; any suffix by default.
        overwrite: see `require_replaceable`.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{option} must end in {', '.join(suffixes)}, got {path}")
    if reason := _find_system_problem(path, errno.ENOENT, errno.ENOTDIR):
        raise InputError(f"{option} {path}: needed a file to write, got '{reason}'; give another name")
    if path.exists() and (kind := describe_kind(path)):
        raise InputError(f"{option} {path}: needed a file to write, got {kind}; give another name")
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: needed an existing folder, got {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(
            f"{option} {path}: needed a writable folder, got {path.parent}, which is read-only; choose another"
        )
    require_replaceable(option, [path], overwrite)


def is_written(path: Path) -> bool:
    """Whether pansplat wrote a file: it is named as the software in the first or last 64 KiB."""
    try:
        with open(path, "rb") as file:
            head = file.read(_SEARCHED_BYTES)
            file.seek(max(os.fstat(file.fileno()).st_size - _SEARCHED_BYTES, len(head)))
            return _WRITTEN.search(head) is not None or _WRITTEN.search(file.read()) is not None
    except OSError:
        return False


def require_replaceable(option: str, files: Iterable[Path], overwrite: bool | None = None) -> None:
    """Check all files of a command before it writes the first: those that exist are empty, or pansplat wrote them.

    Args:
        files: all that are written.
        overwrite: whether files of others may be replaced; None if there is no --overwrite.
    """
    others = [] if overwrite else [f for f in files if f.is_file() and f.stat().st_size and not is_written(f)]
    if others:
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        raise InputError(
            f"{option}: needed names of new files, got {', '.join(map(str, others[:3]))}{more}, which pansplat did not "
            f"write; choose another name{'' if overwrite is None else ', or replace them with --overwrite'}"
        )


def _find_system_problem(path: Path, *expected: int) -> str | None:
    """Why the operating system refuses a path; None for the expected error numbers, and if it does not."""
    try:
        os.stat(path)
    except (OSError, ValueError) as error:
        if getattr(error, "errno", None) not in expected:
            return getattr(error, "strerror", None) or str(error)
    return None
