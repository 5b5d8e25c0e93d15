"""Cube faces among the pictures of a folder: six files of one name."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from pansplat.errors import InputError, InputWarning
from pansplat.images.cube_images import MAX_SIZE, CubeImage, CubeLevel
from pansplat.images.image_files import read_size, require_complete

# Endings of file names for each face, in the order front, right, back, left, up, down. The axes are those of OpenGL's
# cube maps: seen from inside, +x is to the right of +z.
# Source: OpenGL 4.6, table 8.19; https://pannellum.org/documentation/reference/ (cubeMap).
_ENDINGS = (
    ("f", "r", "b", "l", "u", "d"),
    ("front", "right", "back", "left", "up", "down"),
    ("front", "right", "back", "left", "top", "bottom"),
    ("pz", "px", "nz", "nx", "py", "ny"),
    ("posz", "posx", "negz", "negx", "posy", "negy"),
)
_SEPARATED = re.compile(r"(?:(.*?)[_\-. ])?([A-Za-z]+)", re.DOTALL)


def group_faces(images: Sequence[Path]) -> tuple[dict[str, CubeImage], list[Path]]:
    """The cubes of six files each, by name, and the other images. A name without all six faces is no cube.

    Warns if a complete set of faces cannot be used.
    """
    groups: dict[tuple[str, str, int], dict[str, Path]] = {}
    for image in images:
        found = _SEPARATED.fullmatch(image.stem)
        if found is None:
            continue
        for number, endings in enumerate(_ENDINGS):
            if found[2].lower() in endings:
                group = groups.setdefault((found[1] or "", image.suffix.lower(), number), {})
                group.setdefault(found[2].lower(), image)
    cubes: dict[str, CubeImage] = {}
    used: set[Path] = set()
    for (name, _, number), group in groups.items():
        if len(group) < 6 or used & set(group.values()):
            continue
        files = [group[ending] for ending in _ENDINGS[number]]
        if not any(_is_square(file) for file in files):  # these are panoramas with such names
            continue
        used |= set(files)
        try:
            size = require_faces(files)
        except InputError as error:
            warnings.warn(f"cube faces are left out: {error}", category=InputWarning, stacklevel=3)
            continue
        name = name or files[0].parent.resolve().name
        level = CubeLevel(size, size, tuple(file.name for file in files))
        cubes[name if name not in cubes else f"{name}_{len(cubes)}"] = CubeImage(files[0].parent, (level,))
    _note_missing_faces(groups, used)
    return cubes, [image for image in images if image not in used]


def _note_missing_faces(groups: Mapping[tuple[str, str, int], Mapping[str, Path]], used: set[Path]) -> None:
    """Warn about sets of four or five square pictures with the names of faces."""
    largest: dict[tuple[str, str], tuple[int, Mapping[str, Path]]] = {}
    for (name, suffix, number), group in groups.items():
        if len(group) > len(largest.get((name, suffix), (0, {}))[1]):
            largest[name, suffix] = number, group
    for number, group in largest.values():
        files = list(group.values())
        if not 4 <= len(files) < 6 or used & set(files) or not all(_is_square(file) for file in files):
            continue
        missing = ", ".join(f"_{ending}" for ending in _ENDINGS[number] if ending not in group)
        warnings.warn(
            f"{files[0].parent}: needed six cube faces, got {', '.join(file.name for file in files)}; add the picture "
            f"whose name ends in {missing}.",
            category=InputWarning,
            stacklevel=4,
        )


def _is_square(file: Path) -> bool:
    try:
        width, height = read_size(file)
    except InputError:
        return False
    return width == height


def require_faces(files: Sequence[Path]) -> int:
    """The size of six pictures of faces, pixels."""
    sizes = {file: read_size(file) for file in files}
    size = sizes[files[0]]
    for file, (width, height) in sizes.items():
        if width != height or (width, height) != size or width > MAX_SIZE:
            raise InputError(
                f"{file}: needed six square cube faces of one size, at most {MAX_SIZE} pixels, got {width}x{height} "
                f"(and {size[0]}x{size[1]} in {files[0].name}); export them again."
            )
        require_complete(file)
    return size[0]


def find_gap(level: CubeLevel, folder: Path) -> str | None:
    """The first picture of a level that is missing or damaged, in words; None if the level is complete."""
    for file in level.list_files():
        if not (folder / file).is_file():
            return f"{file} is missing"
    for file in level.list_files():
        try:
            require_complete(folder / file)
        except InputError:
            return f"{file} is damaged"
    return None


def keep_complete(levels: Iterable[CubeLevel], folder: Path) -> tuple[list[CubeLevel], str | None]:
    """The complete levels of a size that can be read, the smallest first, and a gap of the others (`find_gap`)."""
    gaps = {level: find_gap(level, folder) for level in levels if 0 < level.size <= MAX_SIZE}
    complete = [level for level, gap in gaps.items() if gap is None]
    return sorted(complete, key=lambda level: level.size), next((gap for gap in [*gaps.values()][::-1] if gap), None)
