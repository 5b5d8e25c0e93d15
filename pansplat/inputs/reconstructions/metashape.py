"""Cameras that Agisoft Metashape exported as XML, with spherical sensors.

The transform of a camera is cam2world in the frame of the chunk (or component), with OpenCV axes; the transform of the
chunk has a rotation, a translation and a scale to the world. The translation is left out: in a geographic system its
origin is the centre of the Earth. Components then have no relation to each other. With a scale the unit is the metre,
otherwise it is arbitrary.

Source: https://github.com/agisoft-llc/metashape-scripts, src/render_spherical_panorama.py (a basis right, up, back
becomes a camera by Scale(1, -1, -1)); nerfstudio.process_data.metashape_utils (the fields of the XML)
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

from pansplat.errors import InputError
from pansplat.inputs.poses import parse_numbers, rigid_matrix
from pansplat.inputs.reconstructions.shots import Reconstruction, find_picture, note_smaller
from pansplat.system.descriptions import describe_count
from pansplat.system.files import read_file

_MAX_BYTES = 1 << 28  # bytes of the largest file that is read
_HEAD = 4096  # bytes at the start of a file from which its kind is known


def find_metashape(folder: Path) -> list[Path]:
    """The first .xml file of a folder that is an export of cameras, if there is one."""
    for path in sorted(folder.glob("*.xml")):
        if not path.is_file():
            continue
        with open(path, "rb") as file:
            head = file.read(_HEAD)
        if b"<document" in head and b"<chunk" in head:
            return [path]
    return []


def read_metashape(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The aligned cameras of spherical sensors; of several components, those of the largest, with a note."""
    data = read_file(source, limit=_MAX_BYTES)
    if b"<!DOCTYPE" in data[:_HEAD] or b"<!ENTITY" in data:
        raise InputError(f"{source}: needed XML of Metashape, got definitions of entities; export it again.")
    try:
        chunk = ElementTree.fromstring(data).find("chunk")
        if chunk is None:
            raise ValueError("no chunk")
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(
            f"{source}: needed cameras exported by Metashape, got another content ({error}); use File > Export > "
            "Export Cameras, Agisoft XML."
        ) from error
    sensors = {sensor.get("id") for sensor in chunk.iter("sensor") if sensor.get("type") == "spherical"}
    cameras = [camera for camera in chunk.iter("camera") if camera.find("transform") is not None]
    spherical = [camera for camera in cameras if camera.get("sensor_id") in sensors]
    if not spherical:
        raise InputError(
            f"{source}: needed aligned cameras of a spherical sensor, got "
            f"{describe_count(len(cameras), 'aligned camera')} and {describe_count(len(sensors), 'spherical sensor')}; "
            "set the camera type to Spherical and align, or move the file away to estimate poses."
        )
    sizes = Counter(camera.get("component_id") for camera in spherical)
    largest = max(sizes, key=sizes.__getitem__)
    note_smaller(source, len(sizes) - 1)
    own = [component for component in chunk.iter("component") if component.get("id") == largest]
    transforms = [each.find("transform") for each in (*own, chunk)]
    transform = next((each for each in transforms if each is not None and each.findtext("scale")), transforms[-1])
    found = _read_transform(transform, source, folder, convention or "cam2world opencv")
    for camera in spherical:
        if camera.get("component_id") == largest:
            name = camera.get("label", "")
            matrix = parse_numbers(camera.findtext("transform") or "", 16, f"{source}, {name!r}").reshape(4, 4)
            found.add(name, find_picture(folder, name), matrix)
    return found


def _read_transform(element: ElementTree.Element | None, source: Path, folder: Path, convention: str) -> Reconstruction:
    """A reconstruction in the world of a transform of the chunk or a component."""
    found = Reconstruction(source, folder, convention)
    rotation, scale = (None if element is None else element.findtext(key) for key in ("rotation", "scale"))
    if rotation:
        found.to_world[:3, :3] = parse_numbers(rotation, 9, f"{source}, rotation").reshape(3, 3)
        found.to_world = rigid_matrix(found.to_world.tolist(), f"{source}, rotation")
    if scale:
        found.scale, found.is_metric = float(parse_numbers(scale, 1, f"{source}, scale")), True
        if not 0 < found.scale < math.inf:
            raise InputError(f"{source}, scale: needed a positive number, got {found.scale}; correct it.")
    return found
