"""Furniture from Sweet Home 3D's free libraries (Debian package sweethome3d-furniture), at its real size.

A library (.sh3f) is a zip file of OBJ models and a catalogue with each model's size in centimetres, optional rotation
and author. The credits list every model that is used, with its licence.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import unescape
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

# Each library's licence, for models without a licence page of their own. Source: Debian's copyright file.
LIBRARIES = {
    "Scopia": "CC BY 3.0",
    "BlendSwap-CC-0": "CC0 1.0",
    "BlendSwap-CC-BY": "CC BY 3.0",
    "KatorLegaz": "CC BY 3.0 US",
}


@dataclass(frozen=True)
class Entry:
    """A model of a library's catalogue; `size` is width, depth and height in metres."""

    library: str
    name: str
    creator: str
    obj: Path
    size: tuple[float, float, float]
    rotation: np.ndarray


@dataclass(frozen=True)
class Credit:
    """A model's author and licence."""

    model: str
    title: str
    author: str
    licence: str
    source: str


def unpack(archive_folder: Path, folder: Path) -> None:
    """Unzip the libraries of `archive_folder` into one folder each."""
    for library in LIBRARIES:
        if not (folder / library).exists():
            with zipfile.ZipFile(archive_folder / f"{library}.sh3f") as archive:
                archive.extractall(folder / library)


def _find_licence(library: str, folder: Path) -> str:
    """The licence on the model's own licence page if it has one, else the licence of its library.

    Some models of the CC-0 library have a page with CC BY.
    """
    for page in sorted(folder.iterdir()):
        if "licen" in page.name.lower():
            text = unescape(re.sub(r"<[^>]*>", " ", page.read_text(encoding="utf-8", errors="replace")))
            if re.search(r"Attribution.{0,20}(Share|Non|NoDer)", text):
                raise ValueError(f"{page}: this licence is not allowed; choose another model")
            if "Attribution 3.0" in text:
                return "CC BY 3.0"
            if re.search(r"CC-?0|CC-Zero|Creative Commons Zero|Public Domain", text, re.IGNORECASE):
                return "CC0 1.0"
            raise ValueError(f"{page}: licence not recognised; choose another model")
    return LIBRARIES[library]


@cache
def catalogue(folder: Path) -> dict[str, Entry]:
    """All models by `library/model`, such as `Scopia/fireplace1`."""
    entries = {}
    for library in LIBRARIES:
        fields: dict[str, dict[str, str]] = {}
        text = (folder / library / "PluginFurnitureCatalog.properties").read_text(encoding="latin1")
        for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
            fields.setdefault(number, {})[key] = value.strip()
        for f in fields.values():
            obj = folder / library / f["model"].lstrip("/")
            if obj.suffix != ".obj" or not obj.exists():
                continue
            size = tuple(float(f[k]) / 100 for k in ("width", "depth", "height"))
            rotation = np.array([float(x) for x in f.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()]).reshape(3, 3)
            entries[f"{library}/{obj.stem}"] = Entry(library, f["name"], f.get("creator", ""), obj, size, rotation)
    return entries


class Furniture:
    """Places models in the scene and collects their credits."""

    def __init__(self, folder: Path) -> None:
        self.entries = catalogue(folder)
        self.credits: dict[str, Credit] = {}
        self._templates: dict[str, list[bpy.types.Object]] = {}

    def _load(self, key: str) -> list[bpy.types.Object]:
        """A model's meshes in metres, upright, standing on z = 0, with its front towards -y."""
        entry = self.entries[key]
        before = set(bpy.data.objects)
        bpy.ops.wm.obj_import(filepath=str(entry.obj), forward_axis="NEGATIVE_Z", up_axis="Y", use_split_objects=False)
        parts = [o for o in bpy.data.objects if o not in before]
        for part in parts:
            for slot in part.material_slots:
                _find_images(slot.material, entry.obj.parent)
        upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)  # y up to z up
        rotation = upright @ entry.rotation @ upright.T
        for part in parts:
            part.data.transform(part.matrix_world)
            part.matrix_world = Matrix.Identity(4)
            part.data.transform(Matrix(rotation.tolist()).to_4x4())
        points = np.concatenate([_read_points(p) for p in parts])
        low, high = points.min(0), points.max(0)
        scale = np.array(entry.size) / np.maximum(high - low, 1e-9)
        middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        for part in parts:
            part.data.transform(Matrix.Diagonal((*scale, 1.0)) @ Matrix.Translation((-middle).tolist()))
            for slot in part.material_slots:
                _make_matt(slot.material)
        licence = _find_licence(entry.library, entry.obj.parent)
        self.credits[key] = Credit(
            entry.obj.stem, entry.name, entry.creator or entry.library, licence, f"{entry.library}.sh3f"
        )
        return parts

    def place(
        self,
        key: str,
        x: float,
        y: float,
        z: float = 0.0,
        *,
        degrees: float = 0.0,
        scale: float | Sequence[float] = 1.0,
        finish: bpy.types.Material | None = None,
        finishes: dict[str, bpy.types.Material] | None = None,
    ) -> None:
        """Place a copy of a model at (x, y, z), rotated counter-clockwise as seen from above.

        Args:
            finish: replaces all materials.
            finishes: replace the materials whose names contain the keys; the first match counts.
        """
        if key not in self._templates:
            self._templates[key] = self._load(key)
            for part in self._templates[key]:
                bpy.context.scene.collection.objects.unlink(part)
        factor = (scale,) * 3 if isinstance(scale, int | float) else tuple(scale)
        placing = (
            Matrix.Translation((x, y, z))
            @ Matrix.Rotation(math.radians(degrees), 4, "Z")
            @ Matrix.Diagonal((*factor, 1))
        )
        for template in self._templates[key]:
            part = template.copy()
            part.data = template.data.copy()
            part.data.transform(placing)
            bpy.context.scene.collection.objects.link(part)
            for slot in part.material_slots:
                name = slot.material.name.lower() if slot.material else ""
                slot.material = finish or next((m for k, m in (finishes or {}).items() if k in name), slot.material)


def _read_points(part: bpy.types.Object) -> np.ndarray:
    flat = np.empty(len(part.data.vertices) * 3)
    part.data.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3)


def _find_images(material: bpy.types.Material | None, folder: Path) -> None:
    """Replace textures whose file is missing by the files in the model's folder, or remove them."""
    if material is None or not material.use_nodes:
        return
    tree = material.node_tree
    for node in [n for n in tree.nodes if n.type == "TEX_IMAGE" and n.image and not n.image.size[0]]:
        name = Path(bpy.path.abspath(node.image.filepath)).stem.lower()
        found = [p for p in sorted(folder.iterdir()) if p.suffix in (".jpg", ".png") and p.stem.lower() in name]
        if found:
            node.image = bpy.data.images.load(str(found[0]), check_existing=True)
        else:
            tree.nodes.remove(node)


def _make_matt(material: bpy.types.Material | None) -> None:
    """Make surfaces matt: highlights and reflections move with the camera, which disturbs stereo matching."""
    if material is None or not material.use_nodes:
        return
    for node in material.node_tree.nodes:
        if node.type == "BSDF_PRINCIPLED":
            node.inputs["Roughness"].default_value = max(0.55, node.inputs["Roughness"].default_value)
            node.inputs["Specular IOR Level"].default_value = 0.2
            node.inputs["Metallic"].default_value = 0.0
            node.inputs["Transmission Weight"].default_value = 0.0
