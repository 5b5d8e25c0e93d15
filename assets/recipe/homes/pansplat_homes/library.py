"""Furniture of Sweet Home 3D as meshes with their real sizes, for generated homes.

`load_furniture` reads the catalogues `*.sh3f` of the Debian package sweethome3d-furniture. Their models are in the
public domain or under Creative Commons Attribution 3.0; `FurnitureLibrary.attribution` lists names, authors, licences.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pansplat.errors import InputError
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import parse_json
from pansplat_homes.meshes import Mesh, MeshMaterial, Texture, make_mesh, read_obj, select_triangles, simplify

_VERSION = 1  # of the cache
_MIN_TRIANGLES, _MAX_TRIANGLES = 8, 5000
_MAX_TEXTURE = 256  # pixels
_LICENCES = {
    "BlendSwap-CC-0": "CC0",
    "BlendSwap-CC-BY": "CC BY 3.0",
    "KatorLegaz": "CC BY 3.0 US",
    "Scopia": "CC BY 3.0",
}
"""Catalogues that are read. That of Reallusion contains people only."""

WALL, FREE, HUNG, CEILING, SURFACE = "wall", "free", "hung", "ceiling", "surface"
"""Places of a piece: on the floor with its back to a wall, on the floor, on a wall, at the ceiling, on other pieces."""

# Catalogue category, pattern of the name, category here, place; the first match counts.
_RULES = (
    ("Bedroom", r"sleeping|card|chessboard|air mattress|rocking", "", ""),
    ("Bedroom", r"\bbed\b|crib|futon", "bed", WALL),
    ("Bedroom", r"convertible", "sofa", WALL),
    ("Bedroom", r"bedside", "nightstand", WALL),
    ("Bedroom", r"wardrobe|cupboard", "wardrobe", WALL),
    ("Bedroom", r"dressing table|changing table|chest|shelves", "cabinet", WALL),
    ("Bedroom", r"clothes rack", "gear", FREE),
    ("Bedroom", r"doll house|rocking horse|wood toy|toy train|teddy", "toy", FREE),
    ("Bedroom", r"handbag|briefcase|folded|clock|rubik|car model|doll$", "small", SURFACE),
    ("Living room", r"contemporary|christmas|deer|phone|control|joystick|rug|guitar", "", ""),
    ("Living room", r"sofa|couch", "sofa", WALL),
    ("Living room", r"armchair|puff|ottoman", "armchair", FREE),
    ("Living room", r"stool|piano bench", "stool", FREE),
    ("Living room", r"coffee table", "coffee table", FREE),
    ("Living room", r"tv stand|television cabinet|dresser", "cabinet", WALL),
    ("Living room", r"bookcase|shelves", "shelf", WALL),
    ("Living room", r"wall flat tv", "tv", HUNG),
    ("Living room", r"\btv\b", "tv", SURFACE),
    ("Living room", r"piano", "piano", WALL),
    ("Living room", r"table", "table", FREE),
    ("Living room", r"chair|bench", "chair", FREE),
    ("Living room", r"fireplace", "fireplace", WALL),
    ("Living room", r"plant|cactus|orchid|bamboo|yucca|ficus|tulip|lily|flower|bonsai|spath", "plant", FREE),
    ("Living room", r"aquarium|dvd|playstation|box", "small", SURFACE),
    ("Kitchen", r"fridge|refrigerator|freezer", "fridge", WALL),
    ("Kitchen", r"microwave|small oven|boiler|^cooker", "small", SURFACE),
    ("Kitchen", r"oven|stove", "stove", WALL),
    ("Kitchen", r"hood", "hood", HUNG),
    ("Kitchen", r"upper", "kitchen upper cabinet", HUNG),
    ("Kitchen", r"^island", "kitchen island", FREE),
    ("Kitchen", r"cabinet|^sink", "kitchen cabinet", WALL),
    ("Kitchen", r"washing machine|dryer", "washing machine", WALL),
    ("Kitchen", r"stool|bar chair|high chair", "stool", FREE),
    ("Kitchen", r"trash|basket", "bin", FREE),
    ("Kitchen", r"fork|^knife$|spoon|cooktop|induction|broom|shovel|^tool$|towel$", "", ""),
    ("Kitchen", r"", "small", SURFACE),
    ("Bathroom", r"shower head|shower door|urinal|potty|curtain|mat$", "", ""),
    ("Bathroom", r"shower", "shower", WALL),
    ("Bathroom", r"bath$|bathtub", "bath", WALL),
    ("Bathroom", r"toilets unit", "toilet", WALL),
    ("Bathroom", r"washbasin|lavatory|vanity", "washbasin", WALL),
    ("Bathroom", r"bidet", "bidet", WALL),
    ("Bathroom", r"radiator", "radiator", WALL),
    ("Bathroom", r"towel rack|dispenser", "towel rack", HUNG),
    ("Bathroom", r"clothes basket", "bin", FREE),
    ("Bathroom", r"bottle|soap|pot|flacon|box", "small", SURFACE),
    ("Lights", r"lamppost|street|park|outdoor|porch|camping|flash|chandelier|candle", "", ""),
    ("Lights", r"wall|spotlight", "wall lamp", HUNG),
    ("Lights", r"hanging|pendant|ceiling|track|fluorescent", "ceiling lamp", CEILING),
    ("Lights", r"", "lamp", FREE),
    ("Office", r"ruler|marker|scissors|pencil|calendar|class seat|stapler", "", ""),
    ("Office", r"chair", "office chair", FREE),
    ("Office", r"desk|table", "desk", WALL),
    ("Office", r"bookcase", "shelf", WALL),
    ("Office", r"filing|safe|water cooler", "cabinet", WALL),
    ("Office", r"white board", "wall decoration", HUNG),
    ("Office", r"dustbin", "bin", FREE),
    ("Office", r"", "small", SURFACE),
    ("Miscellaneous", r"radiator", "radiator", WALL),
    ("Miscellaneous", r"vase|jar|radio|mp3|stereo|gift|book", "small", SURFACE),
    ("Miscellaneous", r"speaker", "speaker", FREE),
    ("Miscellaneous", r"box|crate|barrel|suitcase|trunck|backpack|basketball", "box", FREE),
    ("Miscellaneous", r"ceiling fan", "ceiling lamp", CEILING),
    (
        "Miscellaneous",
        r"step ladder|clothes horse|indoor bike|treadmill|punching|rigged fan|bench|^screen",
        "gear",
        FREE,
    ),
    ("Miscellaneous", r"pool table|table tennis$|football table|flipper", "game", FREE),
    (
        "Miscellaneous",
        r"frame|dart|extinguisher|water heater|internal unit|wall hanger|cuckoo",
        "wall decoration",
        HUNG,
    ),
)


_SOLID_GLASS = ("table", "coffee table", "desk", "stove", "fridge", "washbasin", "tv", "cabinet")
"""Categories in which glass is shown, as an opaque material."""


@dataclass(frozen=True, eq=False)
class FurniturePiece:
    """A piece of furniture.

    Attributes:
        category: such as bed, sofa, chair, plant, stove; see `_RULES`.
        place: WALL, FREE, HUNG, CEILING or SURFACE.
        size: width, height and depth, metres. The front is towards -z and the back towards +z of the mesh.
        elevation: height of the lower side above the floor, metres; 0 for pieces that stand free or on others.
        decode: makes the mesh.
    """

    name: str
    category: str
    place: str
    size: tuple[float, float, float]
    elevation: float
    author: str
    licence: str
    decode: Callable[[], Mesh] = field(repr=False)

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh, decoded at the first use."""
        return self.decode()


@dataclass(frozen=True, eq=False)
class FurnitureLibrary:
    """Pieces of furniture by category."""

    pieces: tuple[FurniturePiece, ...]

    @cached_property
    def by_category(self) -> dict[str, tuple[FurniturePiece, ...]]:
        """The pieces of each category."""
        names = sorted({piece.category for piece in self.pieces})
        return {name: tuple(piece for piece in self.pieces if piece.category == name) for name in names}

    def attribution(self) -> str:
        """Markdown list of all pieces with their authors and licences."""
        lines = ["Models of Sweet Home 3D (https://www.sweethome3d.com), simplified and scaled.", ""]
        for licence in sorted({piece.licence for piece in self.pieces}):
            lines += [f"### {licence}", ""]
            authors: dict[str, list[str]] = {}
            for piece in self.pieces:
                if piece.licence == licence:
                    authors.setdefault(piece.author, []).append(piece.name)
            lines += [f"- {author}: {', '.join(sorted(authors[author]))}" for author in sorted(authors)] + [""]
        return "\n".join(lines)


def load_furniture(folder: Path | str, cache: Path | str | None = None) -> FurnitureLibrary:
    """The furniture of all catalogues `*.sh3f` in a folder.

    Args:
        cache: an .npz file that is written if it does not exist, and read instead of the catalogues if it does.
    """
    if cache is not None and Path(cache).is_file():
        try:
            with np.load(cache, allow_pickle=False) as file:
                arrays = dict(file)
            if int(arrays["version"]) == _VERSION:
                return _unpack(arrays)
        except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            pass  # a damaged cache is made again
    paths = [path for path in sorted(Path(folder).glob("*.sh3f")) if path.stem in _LICENCES]
    if not paths:
        raise InputError(
            f"cannot load furniture: needed catalogues *.sh3f in {folder}, found none; install the Debian package "
            "sweethome3d-furniture, which puts them into /usr/share/sweethome3d/furniture"
        )
    arrays = _pack(piece for path in paths for piece in _read_catalogue(path))
    if cache is not None:
        with replacing(cache) as temporary:
            np.savez_compressed(temporary, **arrays)
    return _unpack(arrays)


def _read_catalogue(path: Path) -> Iterable[tuple[dict[str, Any], Mesh]]:
    """Description and mesh of each usable piece of a catalogue."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
        items: dict[int, dict[str, str]] = {}
        for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*?)\s*$", text, re.MULTILINE):
            items.setdefault(int(number), {})[key] = value
        for item in items.values():
            found = [
                (category, place)
                for kind, pattern, category, place in _RULES
                if kind == item["category"] and re.search(pattern, item["name"].lower())
            ]
            if not found or not found[0][0]:
                continue
            category, place = found[0]
            size = [float(item[key]) / 100 for key in ("width", "height", "depth")]
            elevation = float(item.get("elevation", 0)) / 100
            if place == FREE and category in ("lamp", "plant"):
                if elevation > 1:
                    category, place = "ceiling " + category, CEILING
                elif size[1] < 0.7:
                    category, place = "table " + category, SURFACE
            # The files have y up and the front towards +z; `modelRotation` brings a model there.
            turn = np.array(item.get("modelRotation", "1 0 0 0 1 0 0 0 1").split(), float).reshape(3, 3)
            turn = np.diag((1.0, -1.0, -1.0)) @ turn
            mesh = _read_model(archive, item["model"].lstrip("/"), turn, category in _SOLID_GLASS)
            if len(mesh.material_ids) < _MIN_TRIANGLES:
                continue
            description = {
                "name": item["name"],
                "category": category,
                "place": place,
                "size": size,
                "elevation": elevation if place in (WALL, HUNG, CEILING) else 0.0,
                "author": item.get("creator", path.stem),
                "licence": _LICENCES[path.stem],
            }
            yield description, mesh


def _read_model(archive: zipfile.ZipFile, name: str, turn: NDArray[np.float64], with_glass: bool) -> Mesh:
    """The simplified and turned model of an OBJ file; glass is opaque, or is omitted."""
    folder = PurePosixPath(name).parent
    text = archive.read(name).decode("latin-1")
    triangles, names = read_obj(text)
    rows: dict[str, dict[str, str]] = {}
    for library in re.findall(r"^mtllib\s+(.*?)\s*$", text, re.MULTILINE):
        try:
            mtl = archive.read(str(folder / library)).decode("latin-1")
        except KeyError:
            continue
        row: dict[str, str] = {}
        for line in mtl.splitlines():
            key, _, value = line.strip().partition(" ")
            if key == "newmtl":
                row = rows.setdefault(value.strip(), {})
            else:
                row[key] = value.strip()
    materials, opacities = zip(*(_material(archive, folder, rows.get(key, {})) for key in names), strict=True)
    mesh = make_mesh(simplify(triangles, _MAX_TRIANGLES), materials, turn)
    # The box, which the catalogue's size describes, contains the glass.
    return mesh if with_glass else select_triangles(mesh, np.array(opacities)[mesh.material_ids] > 0.4)


def _material(archive: zipfile.ZipFile, folder: PurePosixPath, row: dict[str, str]) -> tuple[MeshMaterial, float]:
    """A material and its opacity from the lines of an MTL file."""
    color = np.clip([float(word) for word in row.get("Kd", "0.6 0.6 0.6").split()[:3]], 0.0, 0.95)
    opacity = float(row["d"]) if "d" in row else 1.0
    shine = float(row.get("Ns", "0").split()[0]) * max(float(word) for word in row.get("Ks", "0").split()[:3])
    gloss = float(np.clip(shine / 100, 0.0, 0.6))
    texture = _texture(archive, folder, row["map_Kd"]) if "map_Kd" in row else None
    if texture is not None:
        return MeshMaterial((0.9, 0.9, 0.9), texture, gloss), opacity
    red, green, blue = (float(channel) for channel in np.clip(color**2.2, 0.01, 0.9))
    return MeshMaterial((red, green, blue), None, gloss), opacity


def _texture(archive: zipfile.ZipFile, folder: PurePosixPath, name: str) -> Texture | None:
    """The image of a material, reduced to at most 256 pixels a side; None if it is missing or a map of normals."""
    if "normal" in name.lower():
        return None
    words = name.split()
    for words_left in range(len(words), 0, -1):  # options come before the name, which may contain spaces
        try:
            data = archive.read(str(folder / " ".join(words[-words_left:])))
        except KeyError:
            continue
        image = Image.open(io.BytesIO(data)).convert("RGBA")
        image.thumbnail((_MAX_TEXTURE, _MAX_TEXTURE), Image.Resampling.BOX)
        return Texture(np.asarray(image))
    return None


def _pack(pieces: Iterable[tuple[dict[str, Any], Mesh]]) -> dict[str, Any]:
    """Arrays of the cache."""
    parts: dict[str, list[NDArray]] = {
        key: [] for key in ("corners", "normals", "texcoords", "material_ids", "materials")
    }
    descriptions, images, known = [], [], {}
    for description, mesh in pieces:
        rows = []
        for material in mesh.materials:
            image = -1
            if material.texture is not None:
                pixels = material.texture.pixels
                image = known.setdefault(pixels.tobytes(), len(known))
                if image == len(images):
                    stream = io.BytesIO()
                    Image.fromarray(pixels).save(stream, "PNG")
                    images.append(stream.getvalue())
            rows.append((*material.color, material.gloss, image))
        parts["corners"].append(np.rint(mesh.corners * 32767).astype(np.int16))
        parts["normals"].append(np.rint(mesh.normals * 127).astype(np.int8))
        parts["texcoords"].append(mesh.texcoords)
        parts["material_ids"].append(mesh.material_ids.astype(np.int16))
        parts["materials"].append(np.array(rows))
        descriptions.append(description | {"triangles": len(mesh.material_ids), "materials": len(rows)})
    arrays = {key: np.concatenate(value) for key, value in parts.items()}
    return arrays | {
        "version": np.array(_VERSION),
        "pieces": np.array(json.dumps(descriptions)),
        "image_sizes": np.array([len(image) for image in images]),
        "images": np.frombuffer(b"".join(images), np.uint8),
    }


class _Textures(dict[int, Texture]):
    """Textures by index, decoded at the first use."""

    def __init__(self, files: list[bytes]) -> None:
        self.files = files

    def __missing__(self, index: int) -> Texture:
        self[index] = Texture(np.asarray(Image.open(io.BytesIO(self.files[index]))))
        return self[index]


def _unpack(arrays: dict[str, NDArray]) -> FurnitureLibrary:
    ends, data = np.cumsum(arrays["image_sizes"]), arrays["images"].tobytes()
    textures = _Textures([data[end - size : end] for end, size in zip(ends, arrays["image_sizes"], strict=True)])
    pieces, triangle, material = [], 0, 0
    for row in parse_json(str(arrays["pieces"]), "pieces"):
        triangles = slice(triangle, triangle := triangle + row.pop("triangles"))
        materials = slice(material, material := material + row.pop("materials"))
        own = [arrays[key][triangles] for key in ("corners", "normals", "texcoords", "material_ids")]
        decode = partial(_decode, *own, arrays["materials"][materials], textures)
        pieces.append(FurniturePiece(**row | {"size": tuple(row["size"])}, decode=decode))
    return FurnitureLibrary(tuple(pieces))


def _decode(
    corners: NDArray, normals: NDArray, texcoords: NDArray, material_ids: NDArray, rows: NDArray, textures: _Textures
) -> Mesh:
    materials = [
        MeshMaterial((red, green, blue), None if image < 0 else textures[int(image)], gloss)
        for red, green, blue, gloss, image in rows.tolist()
    ]
    return Mesh(
        np.divide(corners, 32767, dtype=np.float32),
        np.divide(normals, 127, dtype=np.float32),
        texcoords,
        material_ids.astype(np.int32),
        tuple(materials),
    )
