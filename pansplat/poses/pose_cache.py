"""What poses are estimated from, on disk: features of panoramas and relative poses of pairs, by their inputs' hash.

A panorama that is added to a tour then costs its own features and pairs only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from pansplat.system.cache_folders import cache_folders, write_cache_file
from pansplat.system.files import read_file

_TREE = "tree"  # name of the array that describes the value
_FAULTS = (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile)  # of a missing or damaged file
_FORMAT = "1"  # version of the file's layout; part of the hash

Value = TypeVar("Value")


class PoseCache:
    """Files with values of some dataclasses, whose fields are arrays, tensors, numbers, texts, tuples and dataclasses.

    Args:
        folder: of the panoramas; the files are in its cache folder (`cache_folders`). None keeps nothing.
        types: the dataclasses.
        fingerprint: changes with the code that computes the values.
    """

    def __init__(self, folder: Path | None, types: Sequence[type], fingerprint: str) -> None:
        self._folders = [] if folder is None else cache_folders(folder)
        self._types, self._fingerprint = {each.__name__: each for each in types}, f"{_FORMAT}-{fingerprint}"

    def get(self, stem: str, key: str, compute: Callable[[], Value]) -> Value:
        """The value of a key: from a file, or computed and written. Outdated files of the stem are deleted.

        Args:
            stem: names what the value describes, such as a panorama by a hash of its content.
            key: all else that the value depends on.
        """
        if not self._folders:
            return compute()
        name = f"{stem}-{hash_parts(self._fingerprint, key)}.npz"
        for folder in self._folders:
            with contextlib.suppress(*_FAULTS):
                return self._read(folder / name)
        value = compute()
        written = write_cache_file(self._folders, name, self._pack(value))
        for old in [] if written is None else written.parent.glob(f"{stem}-*.npz"):
            if old.name != name:
                old.unlink(missing_ok=True)
        return value

    def list_values(self, prefix: str) -> list[Any]:
        """The values in files whose stem begins with a prefix, with an empty key."""
        found = []
        for folder in self._folders:
            for path in sorted(folder.glob(f"{prefix}*-{hash_parts(self._fingerprint, '')}.npz")):
                with contextlib.suppress(*_FAULTS):
                    found.append(self._read(path))
        return found

    def _pack(self, value: object) -> bytes:
        arrays: list[np.ndarray] = []

        def describe(part: Any) -> Any:
            if isinstance(part, (np.ndarray, torch.Tensor)):
                arrays.append(np.asarray(part))
                return {"$array": len(arrays) - 1, "$tensor": isinstance(part, torch.Tensor)}
            if dataclasses.is_dataclass(part) and type(part).__name__ in self._types:
                fields = [field.name for field in dataclasses.fields(part)]
                return {"$type": type(part).__name__} | {name: describe(getattr(part, name)) for name in fields}
            if isinstance(part, tuple):
                return [describe(each) for each in part]
            if part is None or isinstance(part, (bool, int, float, str)):
                return part
            raise TypeError(f"cannot cache a {type(part).__name__}")

        file, tree = io.BytesIO(), json.dumps(describe(value)).encode()
        np.savez_compressed(
            file, **{_TREE: np.frombuffer(tree, np.uint8)}, **{f"a{n}": a for n, a in enumerate(arrays)}
        )
        return file.getvalue()

    def _read(self, path: Path) -> Any:
        with np.load(io.BytesIO(read_file(path)), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}

        def restore(part: Any) -> Any:
            if isinstance(part, list):
                return tuple(restore(each) for each in part)
            if not isinstance(part, dict):
                return part
            if "$array" in part:
                array = arrays[f"a{part['$array']}"]
                return torch.from_numpy(array) if part["$tensor"] else array
            return self._types[part["$type"]](**{name: restore(each) for name, each in part.items() if name != "$type"})

        return restore(json.loads(arrays[_TREE].tobytes()))


def hash_parts(*parts: str | np.ndarray) -> str:
    """A hash of texts and arrays."""
    digest = hashlib.blake2b(digest_size=8)
    for part in parts:
        content = part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()
