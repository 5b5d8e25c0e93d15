"""A .ply file written part by part, for scenes that do not fit in memory.

A header tells how many vertices follow, which only the end knows: room is left for it, and it is filled last. The
file has the layout of one by `save_ply`, with spaces after its comment.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from pansplat.atomic import replacing
from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.ply import header, is_finite, runs_of, table
from pansplat.gaussians.scene import Scene

_ROOM = 4096  # bytes for the runs of level and view: some 300. Viewers in browsers want the header within 10,000 bytes


def save_ply_parts(scene: Scene, parts: Iterable[Gaussians], path: str | Path) -> int:
    """Write parts one after another, atomically; no more than one is held.

    Gaussians with a non-finite number are left out with a warning.

    Args:
        scene: cameras and names for the header; its own Gaussians are not written.
        parts: all of one degree.

    Returns:
        How many Gaussians the file holds.

    Raises:
        InputError: when the folder does not exist or cannot be written.
        ValueError: a part has another degree than the first.
    """
    path = Path(path)
    with replacing(path) as partial:
        rest = iter(parts)
        first = [next(rest, scene.gaussians.select(scene.gaussians.levels < 0))]
        coefficients = first[0].harmonics.shape[1]
        room = len(header(scene, [], coefficients)) + _ROOM
        with open(partial, "wb") as file:
            file.write(b" " * room)
            runs, lost = _write_parts(_taken(first, rest), file, coefficients)
        _fill_header(partial, header(scene, runs, coefficients, size=room), room)
    count = sum(run[2] for run in runs)
    if lost:
        warnings.warn(f"{path}: left out {lost} of {count + lost} Gaussians that are not finite", stacklevel=2)
    return count


def _taken(first: list[Gaussians], rest: Iterator[Gaussians]) -> Iterator[Gaussians]:
    """First and rest; parts are large, so none is held here."""
    yield first.pop()
    yield from rest


def _write_parts(parts: Iterable[Gaussians], file: BinaryIO, coefficients: int) -> tuple[list[list[int]], int]:
    """Write the vertices; stretches of one level and view, and how many Gaussians were not finite."""
    runs: list[list[int]] = []
    lost = 0
    for part in parts:
        if part.harmonics.shape[1] != coefficients:
            raise ValueError(f"`parts` must have {coefficients} harmonics each, got {part.harmonics.shape[1]}")
        finite = is_finite(part)
        kept = part if bool(finite.all()) else part.select(finite)
        lost += len(part) - len(kept)
        for level, view, count in runs_of(kept):
            if runs and runs[-1][:2] == [level, view]:
                runs[-1][2] += count
            else:
                runs.append([level, view, count])
        table(kept).tofile(file)
        del part, kept
    return runs, lost


def _fill_header(path: Path, content: bytes, room: int) -> None:
    """Put the header where room was left; where it needs more, the vertices are moved on, piece by piece."""
    if len(content) == room:
        with open(path, "r+b") as file:
            file.write(content)
        return
    with replacing(path) as longer, open(path, "rb") as vertices, open(longer, "wb") as file:
        file.write(content)
        vertices.seek(room)
        shutil.copyfileobj(vertices, file, 1 << 24)
