"""Cube faces among the pictures of a folder: six files of one name, and pictures that hold all six faces."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2

from pansplat.errors import InputError, InputWarning
from pansplat.images.cube_images import MAX_SIZE, CubeImage, CubeLevel, measure_seams
from pansplat.images.image_files import read_pixels, read_size, require_complete, require_two_to_one

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

# Orders of the faces in a row, a column, or two rows or columns: Pannellum and Pano2VR, krpano, OpenGL and FFmpeg,
# V-Ray, Marzipano.
# Source: https://pannellum.org/documentation/reference/; https://krpano.com/docu/xml/#image.cubestrip;
# https://ffmpeg.org/ffmpeg-filters.html#v360; https://www.marzipano.net/reference/ImageUrlSource.html
_ORDERS = ("frblud", "lfrbud", "rludfb", "rludbf", "bdflru")
_GRIDS = ((1, 6), (6, 1), (2, 3), (3, 2))  # rows, columns

# Crosses: row and column of the faces front, right, back, left, up, down, and their quarter turns.
_CROSSES = {
    (3, 4): (
        ((1, 1, 0), (1, 2, 0), (1, 3, 0), (1, 0, 0), (0, 1, 0), (2, 1, 0)),
        ((1, 0, 0), (1, 1, 0), (1, 2, 0), (1, 3, 0), (0, 0, 0), (2, 0, 0)),
    ),
    (4, 3): (((1, 1, 0), (1, 2, 0), (3, 1, 2), (1, 0, 0), (0, 1, 0), (2, 1, 0)),),
}

_SMALL = 64  # largest size of a face whose edges are compared, pixels
_MAX_SEAM = 3.0  # difference across the edges over that inside
_SEAM_NOISE = 2.0  # grey values
_MAX_RATIO = 0.5  # of the difference to that of faces in a wrong order; above it everything fits everything


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
        if not any(_is_square(file) for file in files):  # panoramas of these names
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


def read_picture(image: Path) -> Path | CubeImage:
    """A 2:1 picture as it is, or the cube in a picture that holds all six faces; an error for another picture."""
    width, height = read_size(image)
    if width == 2 * height:
        require_complete(image)
        return image
    layout = find_layout(image)
    if layout is None:
        require_two_to_one(image, width, height)
    return layout


def find_layout(image: Path) -> CubeImage | None:
    """The cube in a picture that holds all six faces; None if it is another picture.

    The proportions give the arrangement, and the edges of the faces give their order. The edges must fit, because
    photographs have such proportions, too.
    """
    width, height = read_size(image)
    grids = [grid for grid in (*_GRIDS, *_CROSSES) if width * grid[0] == height * grid[1] and width % grid[1] == 0]
    if not grids or width // grids[0][1] > MAX_SIZE:
        return None
    (grid,) = grids
    pixels = read_pixels(image)
    rows, columns = grid
    side = min(_SMALL, width // columns)
    small = cv2.resize(pixels, (columns * side, rows * side), interpolation=cv2.INTER_AREA)
    levels = [
        CubeLevel(width // columns, width // columns, 6 * (image.name,), grid, cells) for cells in _list_cells(grid)
    ]
    faces = [level.read(image.parent, lambda _: small) for level in levels]
    seams = [measure_seams(six) for six in faces]
    best = min(range(len(levels)), key=lambda n: seams[n][0])
    across, inside = seams[best]
    wrong, _ = measure_seams([*faces[best][1:], faces[best][0]])
    if across > _MAX_SEAM * inside + _SEAM_NOISE or across >= _MAX_RATIO * wrong:
        return None
    return CubeImage(image.parent, (levels[best],))


def strip_level(image: str, size: int, order: str) -> CubeLevel:
    """A column of six faces in a picture; `order` holds the letters of the faces from the top."""
    cells = tuple((order.index(face), 0, 0) for face in _ORDERS[0])
    return CubeLevel(size, size, 6 * (image,), (6, 1), cells)


def _list_cells(grid: tuple[int, int]) -> Iterator[tuple[tuple[int, int, int], ...]]:
    if grid in _CROSSES:
        yield from _CROSSES[grid]
        return
    places = list(itertools.product(range(grid[0]), range(grid[1])))
    for order in _ORDERS:
        yield tuple((*places[order.index(face)], 0) for face in _ORDERS[0])
