"""The store: what is computed from a folder's panoramas, in files by the hash of all that it depends on.

An entry, `KIND-KEY.entry`, is in `.pansplat/` of the folder, or in the user's cache folder if that cannot be written,
or else, and without caches (`without_caches`), in a temporary folder, which is removed when the process ends.
It is safetensors, whose metadata is a tree of JSON, and a CRC-32. Entries appear complete or not at all, and processes
may share a folder. The entries that were used least recently are removed when they have more than `LIMIT` bytes
together, but none that this process has used, or another one in the last hour.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import hashlib
import json
import os
import secrets
import shutil
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors.numpy
import torch

from pansplat.errors import InputError, InputWarning
from pansplat.system.atomic import is_unfinished, replacing
from pansplat.system.files import expand_home, read_file

LIMIT = 4 << 30  # bytes that the entries of a folder may take; the least recently used are removed
_SUFFIX = ".entry"
_IN_USE_SECONDS = 3600.0  # entries that another process used less than this time ago are not removed
_ABANDONED_SECONDS = 3600.0  # an unfinished file that is older is that of a process that was killed
_FORMAT = "1"  # version of the entries' format, which is part of their keys
_TREE = "tree"  # name of an entry's metadata

_used: set[str] = set()  # paths of the entries that this process used, which are not removed
_block: ContextVar[str] = ContextVar("block", default="")  # names the temporary folder of a block without caches

Value = TypeVar("Value")


@contextlib.contextmanager
def without_caches() -> Iterator[None]:
    """Nothing is read from caches or kept there in the block."""
    token = _block.set(_block.get() or secrets.token_hex(8))
    try:
        yield
    finally:
        _block.reset(token)


class Store:
    """The entries of a folder: arrays, tensors, JSON, tuples and dataclasses of these.

    Args:
        folder: that of the panoramas; None keeps nothing.
        types: the dataclasses.
    """

    def __init__(self, folder: Path | None, types: Sequence[type] = ()) -> None:
        self._folders = [] if folder is None else cache_folders(folder)
        self._types = {each.__name__: each for each in types}

    def get(self, kind: str, key: str, compute: Callable[[], Value]) -> Value:
        """The value of an entry, which is computed and written if there is none."""
        value = self.read(kind, key)
        if value is None:
            value = compute()
            self.write(kind, key, value)
        return value

    def find(self, kind: str, key: str) -> list[Path]:
        """The files of an entry, of which the first that is not damaged counts."""
        paths = (folder / f"{kind}-{hash_parts(_FORMAT, key)}{_SUFFIX}" for folder in self._folders)
        return [path for path in paths if os.path.isfile(path)]

    def read(self, kind: str, key: str) -> Any:
        """The value of an entry; None if there is none, with a note if it is damaged."""
        found = (self._open(path) for path in self.find(kind, key))
        return next((value for value in found if value is not None), None)

    def list_values(self, kind: str) -> list[Any]:
        """The values of all entries of a kind."""
        paths = [path for folder in self._folders for path in sorted(folder.glob(f"{kind}-*{_SUFFIX}"))]
        return [value for path in paths if (value := self._open(path)) is not None]

    def write(self, kind: str, key: str, value: object) -> None:
        """Write an entry to the first writable folder, if any."""
        content = _pack(value, self._types) if self._folders else b""
        written = write_cache_file(self._folders, f"{kind}-{hash_parts(_FORMAT, key)}{_SUFFIX}", content)
        if written is not None:
            _used.add(str(written))
            _prune(written.parent)

    def _open(self, path: Path) -> Any:
        try:
            value = read_entry(path, self._types)
        except InputError:
            if path.exists():  # another process may have removed it
                warnings.warn(f"{path} is damaged, and is computed again.", InputWarning, stacklevel=4)
            return None
        _used.add(str(path))
        with contextlib.suppress(OSError):
            os.utime(path)  # the modification time states when the entry was last used
        return value


def hash_parts(*parts: str | np.ndarray) -> str:
    """A hash of texts and arrays."""
    digest = hashlib.sha256()
    for part in parts:
        content = os.fsencode(part) if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
        digest.update(len(content).to_bytes(8, "little"))
        digest.update(content)
    return digest.hexdigest()[:32]


def hash_file(path: Path) -> str:
    """A hash of a file's bytes, which are read again when its size, times or inode have changed."""
    try:
        state = os.stat(path)
    except OSError:
        read_file(path)  # raises the error that names it
        raise
    return _hash_content(path, (state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino))


@lru_cache(maxsize=1 << 16)
def _hash_content(path: Path, state: tuple[int, ...]) -> str:
    del state  # it is only part of the key of the cache
    return hashlib.sha256(read_file(path)).hexdigest()[:32]


def cache_folders(folder: Path) -> list[Path]:
    """Folders for what is computed from a folder's panoramas, in order of preference."""
    folder_hash = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=8).hexdigest()
    folders = [folder / ".pansplat"]
    with contextlib.suppress(InputError):  # there may be no home folder
        home = os.environ.get("XDG_CACHE_HOME") or expand_home("~/.cache")
        folders.append(Path(home) / "pansplat" / folder_hash)
    block = _block.get()
    return [*(() if block else folders), _name_temporary() / (block + folder_hash)]


@cache
def _name_temporary() -> Path:
    """The temporary folder of this process, which is made when a file is written."""
    base = os.devnull  # nothing can be written below it
    with contextlib.suppress(OSError):
        base = tempfile.gettempdir()
    folder = Path(base) / f"pansplat-{secrets.token_hex(8)}"
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def write_cache_file(folders: Sequence[Path], name: str, content: bytes) -> Path | None:
    """Write a file to the first writable folder; returns its path, or None if there is no such folder."""
    for folder in folders:
        try:
            if folder.parent == _name_temporary():
                folder.parent.mkdir(0o700, exist_ok=True)
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if (folder / name).is_symlink():  # whoever made the folder could redirect its files
                (folder / name).unlink()
            with replacing(folder / name) as unfinished:
                unfinished.write_bytes(content)
        except (OSError, InputError):
            continue
        return folder / name
    return None


def _prune(folder: Path) -> None:
    """Remove unfinished files of processes that were killed, and the entries that were used least recently."""
    entries, now = [], time.time()
    with contextlib.suppress(OSError):  # another process removes files, too
        for file in folder.iterdir():
            state = file.stat()
            if is_unfinished(file) and now - state.st_mtime > _ABANDONED_SECONDS:
                file.unlink()
            elif file.suffix == _SUFFIX:
                entries.append((state.st_mtime, state.st_size, file))
    total = sum(size for _, size, _ in entries)
    for used, size, file in sorted(entries):
        if total > LIMIT and str(file) not in _used and now - used > _IN_USE_SECONDS:
            with contextlib.suppress(OSError):
                file.unlink()
                total -= size


def _pack(value: object, types: dict[str, type]) -> bytes:
    arrays: dict[str, np.ndarray] = {}

    def describe(part: Any) -> Any:
        if isinstance(part, (np.ndarray, torch.Tensor)):
            is_tensor = isinstance(part, torch.Tensor)
            name = str(len(arrays))
            arrays[name] = np.asarray(part.detach().cpu() if isinstance(part, torch.Tensor) else part, order="C")
            return {"$tensor" if is_tensor else "$array": name}
        if type(part).__name__ in types:
            fields = {field.name: describe(getattr(part, field.name)) for field in dataclasses.fields(part)}
            return {"$type": type(part).__name__, "$fields": fields}
        if isinstance(part, tuple):
            return {"$tuple": [describe(each) for each in part]}
        if isinstance(part, list):
            return [describe(each) for each in part]
        if isinstance(part, dict):
            return {"$fields": {name: describe(each) for name, each in part.items()}}
        if part is None or isinstance(part, (bool, int, float, str)):
            return part
        raise TypeError(f"cannot store a {type(part).__name__}")

    body = safetensors.numpy.save(arrays, {_TREE: json.dumps(describe(value))})
    return body + zlib.crc32(body).to_bytes(4, "little")


def read_entry(path: Path, types: dict[str, type] | None = None) -> Any:
    """The value of an entry; an InputError if it is damaged.

    Args:
        path: the file.
        types: the dataclasses in it, by name.
    """
    content = read_file(path)
    try:
        return _unpack(content, types or {})
    except Exception as error:  # a damaged file may have any content
        raise InputError(f"{path}: needed an entry of the cache, got another content; delete the file.") from error


def _unpack(content: bytes, types: dict[str, type]) -> Any:
    body, checksum = content[:-4], int.from_bytes(content[-4:], "little")
    if zlib.crc32(body) != checksum:
        raise ValueError
    arrays = safetensors.numpy.load(body)
    header = json.loads(body[8 : 8 + int.from_bytes(body[:8], "little")])

    def restore(part: Any) -> Any:
        if isinstance(part, list):
            return [restore(each) for each in part]
        if not isinstance(part, dict):
            return part
        kind, value = next(iter(part.items()))
        if kind == "$tensor":
            return torch.from_numpy(arrays[value])
        if kind == "$array":
            return arrays[value]
        if kind == "$tuple":
            return tuple(restore(each) for each in value)
        fields = {name: restore(each) for name, each in part["$fields"].items()}
        return fields if kind == "$fields" else types[value](**fields)

    return restore(json.loads(header["__metadata__"][_TREE]))
