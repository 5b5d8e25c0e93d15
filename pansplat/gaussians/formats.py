"""Scene files of all formats, by suffix: .ply, .compressed.ply, .spz, .splat, .sog and .glb (docs/formats.md).

.ply and .glb are read and written here. The library gaussforge codes the others, in a child process: it is compiled
code, and a damaged file may crash it. Gaussians pass between the processes as a plain .ply.

Convention: the world of a scene has y down (docs/conventions.md), as the files of 3DGS. .spz and .glb have y up: the
scene is rotated by half a turn about x.

Source: https://github.com/nianticlabs/spz (axes RUB, entry in the comment of the gzip header),
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats (compressed .ply, .sog).
"""

from __future__ import annotations

import io
import subprocess
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.gltf import load_glb, save_glb
from pansplat.gaussians.ply import COMMENT_PREFIX, find_entry, format_plain_ply, load_ply, read_ply, save_ply
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import (
    Y_UP,
    find_label_runs,
    format_entry,
    limit_degree,
    restore_scene,
    select_finite,
    sort_by_label,
)
from pansplat.geometry.morton import morton_codes
from pansplat.system.atomic import replacing
from pansplat.system.files import find_scene_suffix, read_file, require_file

_MAX_FILE = 1 << 32  # bytes of the largest file that is read or written
_MAX_ENTRY_BYTES = 1 << 26  # bytes of the largest pansplat entry
_EXPANSION, _FREE_BYTES = 256, 1 << 26  # limit of the decoded bytes: for each byte of the file, and in addition
_DECODED_BYTES = 236  # bytes of a decoded Gaussian with harmonics of degree 3
_DECODE_SECONDS = 600  # a damaged file may not end
_CODER = """
import os, sys
sys.path[:] = [folder for folder in sys.path if folder]  # without the current folder
output = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)  # the library prints
import gaussforge
limit = int(sys.argv[3])
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    used, page = int(open("/proc/self/statm").read().split()[0]), os.sysconf("SC_PAGE_SIZE")
    most = min(os.sysconf("SC_PHYS_PAGES"), used + 8 * limit // page) * page  # Gaussians are held several times
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
except (ImportError, OSError, ValueError):
    pass
result = gaussforge.GaussForge().convert(sys.stdin.buffer.read(), sys.argv[1], sys.argv[2])
if "error" in result:
    sys.exit(result["error"])
if not result["data"]:
    sys.exit("it holds no Gaussians")
if len(result["data"]) > limit:
    sys.exit(f"it decodes to more than {limit:,} bytes")
output.write(result["data"])
output.close()
"""


@dataclass(frozen=True)
class _Coded:
    """A format that gaussforge reads and writes.

    Attributes:
        name: the library's name of the format.
        magic: first bytes, one of them.
        degree: highest degree of the spherical harmonics.
        insert_entry, find_entry: write and read the pansplat entry in a file's bytes; None without a place for it.
        y_up: whether the axes of the file have y up.
        order: sorts the Gaussians; near ones should follow each other where they share a range or a tile.
        max_gaussians, max_position: limits; metres.
        count: the Gaussians that the bytes of a file state, without decoding it.
    """

    name: str
    degree: int
    magic: tuple[bytes, ...] = (b"",)
    insert_entry: Callable[[bytes, str], bytes] | None = None
    find_entry: Callable[[bytes], str | None] | None = None
    y_up: bool = False
    order: Callable[[Gaussians], Gaussians] = sort_by_label
    max_gaussians: int = (1 << 31) - 1
    max_position: float = float("inf")
    count: Callable[[bytes], int] = lambda content: 0


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene in the format of the file's suffix, atomically, in the user's unit.

    Gaussians with a non-finite value are left out with a warning, and so are harmonics above the format's degree.
    """
    path, scene = Path(path), scene.scaled(scene.frame.unit)
    coded = _CODED.get(find_scene_suffix(path))
    if coded is not None:
        _save_coded(scene, path, coded)
    elif find_scene_suffix(path) == ".glb":
        save_glb(scene, path)
    else:
        save_ply(scene, path)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file of `save_scene` or of another tool.

    A file without a pansplat entry gives a scene without cameras, with all Gaussians at level 0 of view 0.
    """
    path = Path(path)
    if path.is_dir():
        require_file(path, "a scene file")
    suffix = find_scene_suffix(path)
    require_file(path, f"a {suffix} scene")
    if suffix == ".ply" and _is_compressed(path):
        suffix = ".compressed.ply"
    if suffix in _CODED:
        return _load_coded(path, _CODED[suffix])
    return load_glb(path) if suffix == ".glb" else load_ply(path)


def _save_coded(scene: Scene, path: Path, coded: _Coded) -> None:
    gaussians = select_finite(scene.gaussians, path)
    if not 0 < len(gaussians) <= coded.max_gaussians:
        raise InputError(
            f"cannot write {path}: the format holds 1 to {coded.max_gaussians:,} Gaussians, got {len(gaussians):,}; "
            "write a .ply, or change the number with `pansplat refine --gaussians`"
        )
    largest = float(gaussians.means.abs().max())
    if largest >= coded.max_position:
        raise InputError(
            f"cannot write {path}: the format holds positions below {coded.max_position:g} m, got {largest:.6g} m; "
            "write a .ply or .glb"
        )
    gaussians = coded.order(limit_degree(gaussians, coded.degree, path))
    content = _encode(gaussians.rotated(Y_UP) if coded.y_up else gaussians, path, coded)
    if coded.insert_entry is not None:
        content = coded.insert_entry(content, format_entry(scene, find_label_runs(gaussians)))
    elif any(scene.frame.origin):
        origin = ", ".join(f"{x:.15g}" for x in scene.frame.origin)
        message = f"{path}: positions are relative to ({origin}), which the format does not hold"
        warnings.warn(message, InputWarning, stacklevel=4)
    with replacing(path) as partial:
        partial.write_bytes(content)


def _load_coded(path: Path, coded: _Coded) -> Scene:
    content = read_file(path, f"a .{coded.name} scene", limit=_MAX_FILE)
    if not content.startswith(coded.magic):
        raise InputError(f"{path}: needed a .{coded.name} scene, got a file that starts with {content[:8]!r}; check it")
    gaussians, _ = read_ply(io.BytesIO(_decode(content, path, coded)), path)
    entry = None if coded.find_entry is None else coded.find_entry(content)
    return restore_scene(gaussians.rotated(Y_UP) if coded.y_up else gaussians, entry, path)


def _encode(gaussians: Gaussians, path: Path, coded: _Coded) -> bytes:
    if coded.name == "compressed.ply":  # gaussforge 0.6.0 writes the harmonics by coefficient, and reads by channel
        rest = gaussians.harmonics[:, 1:].transpose(1, 2).reshape(len(gaussians), -1, 3)
        gaussians = replace(gaussians, harmonics=torch.cat((gaussians.harmonics[:, :1], rest), dim=1))
    try:
        return _convert(format_plain_ply(gaussians), "ply", coded.name)
    except _CoderError as error:
        raise InputError(f"cannot write {path}: {error}; write a .ply") from error


def _decode(content: bytes, path: Path, coded: _Coded) -> bytes:
    limit = _FREE_BYTES + _EXPANSION * len(content)
    try:
        if coded.count(content) * _DECODED_BYTES > limit:
            raise _CoderError(f"it decodes to more than {limit:,} bytes")
        return _convert(content, coded.name, "ply", limit, _DECODE_SECONDS)
    except (_CoderError, zlib.error) as error:
        raise InputError(
            f"{path}: needed a complete .{coded.name} scene, got damaged data ({error}); copy or export it again"
        ) from error


class _CoderError(Exception):
    """The child process did not succeed."""


def _convert(content: bytes, source: str, target: str, limit: int = _MAX_FILE, seconds: float | None = None) -> bytes:
    """The bytes of a file in another format, at most `limit`, by gaussforge in a child process."""
    command = [sys.executable, "-c", _CODER, source, target, str(limit)]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        raise _CoderError(f"no result after {seconds:g} s") from None
    if done.returncode == 0:
        return done.stdout
    if done.returncode < 0:
        raise _CoderError(f"gaussforge stopped by signal {-done.returncode}")
    # On Windows a crash has a positive status and no message.
    lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"gaussforge stopped, {done.returncode:#x}"]
    raise _CoderError(lines[-1][:200])


def _is_compressed(path: Path) -> bool:
    """Whether a .ply has packed vertices."""
    with open(path, "rb") as file:
        header = file.read(1 << 16)
    return b"packed_position" in header.split(b"end_header", 1)[0]


# Order


def _sort_by_label_and_place(gaussians: Gaussians) -> Gaussians:
    keys = (_find_place(gaussians), gaussians.views.cpu().numpy(), gaussians.levels.cpu().numpy())
    return gaussians.select(torch.from_numpy(np.lexsort(keys)))


def _sort_by_place(gaussians: Gaussians) -> Gaussians:
    return gaussians.select(torch.from_numpy(np.argsort(_find_place(gaussians), kind="stable")))


def _find_place(gaussians: Gaussians) -> np.ndarray:
    """Position of each mean along a Z-order curve through the bounds, 63 bits.

    The arithmetic is that of gaussforge, which sorts a .sog along this curve: its sort then changes nothing, and the
    labels of the entry stay in order.
    """
    means = gaussians.means.detach().cpu().numpy().astype(np.float32)
    low, extent = means.min(axis=0), np.ptp(means, axis=0)
    steps = np.where(extent > 1e-8, np.float32(2097151) / np.maximum(extent, np.float32(1e-30)), np.float32(0))
    cells = np.minimum(((means - low) * steps).astype(np.int64), 2097151)
    return morton_codes(cells)


# The pansplat entry of each format


def _insert_ply_comment(content: bytes, entry: str) -> bytes:
    end = content.index(b"\n", content.index(b"\nformat ") + 1) + 1
    return content[:end] + f"comment {COMMENT_PREFIX}{entry}\n".encode() + content[end:]


def _find_ply_comment(content: bytes) -> str | None:
    lines = content[: max(content.find(b"end_header"), 0)].decode(errors="replace").split("\n")
    return find_entry([line.removeprefix("comment ").strip() for line in lines if line.startswith("comment ")])


_GZIP_HEADER, _GZIP_COMMENT = 10, 0x10  # bytes of a header without fields; its flag that a comment follows


def _insert_gzip_comment(content: bytes, entry: str) -> bytes:
    if content[:2] != b"\x1f\x8b" or content[3]:
        return content
    header = content[:3] + bytes([_GZIP_COMMENT]) + content[4:_GZIP_HEADER]
    return header + (COMMENT_PREFIX + entry).encode() + b"\0" + content[_GZIP_HEADER:]


def _find_gzip_comment(content: bytes) -> str | None:
    if content[:2] != b"\x1f\x8b" or content[3:4] != bytes([_GZIP_COMMENT]):
        return None
    end = content.find(b"\0", _GZIP_HEADER, _GZIP_HEADER + _MAX_ENTRY_BYTES)
    return find_entry([content[_GZIP_HEADER : max(end, _GZIP_HEADER)].decode("latin-1")])


_ZIP_ENTRY = "pansplat.json"


def _count_spz(content: bytes) -> int:
    """Gaussians of the header, which is compressed up to version 3 of the format."""
    if content[:2] == b"\x1f\x8b":
        content = zlib.decompressobj(31).decompress(content, 12)
    return int.from_bytes(content[8:12], "little")


def _insert_zip_entry(content: bytes, entry: str) -> bytes:
    buffer = io.BytesIO(content)
    with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(_ZIP_ENTRY), entry, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _find_zip_entry(content: bytes) -> str | None:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive, archive.open(_ZIP_ENTRY) as file:
            return file.read(_MAX_ENTRY_BYTES).decode(errors="replace")
    except Exception:  # the standard library raises many types for a damaged archive
        return None


_CODED = {
    ".compressed.ply": _Coded(
        "compressed.ply", 3, (b"ply",), _insert_ply_comment, _find_ply_comment, order=_sort_by_label_and_place
    ),
    ".spz": _Coded(
        "spz", 3, (b"\x1f\x8b", b"NGSP"), _insert_gzip_comment, _find_gzip_comment,
        y_up=True, max_gaussians=10_000_000, max_position=2048, count=_count_spz,
    ),
    ".splat": _Coded("splat", 0),
    ".sog": _Coded("sog", 3, (b"PK\x03\x04",), _insert_zip_entry, _find_zip_entry, order=_sort_by_place),
}  # fmt: skip
