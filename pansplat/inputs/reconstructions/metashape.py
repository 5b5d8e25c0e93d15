"""Cameras that Agisoft Metashape exported as XML, with spherical sensors.

The transform of a camera is cam2world in the frame of the chunk (or component), with OpenCV axes; the transform of the
chunk has a rotation, a translation and a scale to the world. The translation is left out: in a geographic system its
origin is the centre of the Earth. Components then have no relation to each other. With a scale the unit is the metre,
otherwise it is arbitrary.

Source: https://github.com/agisoft-llc/metashape-scripts, src/render_spherical_panorama.py (a basis right, up, back
becomes a camera by Scale(1, -1, -1)); nerfstudio.process_data.metashape_utils (the fields of the XML)
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch

from pansplat.errors import InputError
from pansplat.inputs.poses import rigid_matrix, to_cam2world
from pansplat.inputs.reconstructions.shots import Reconstruction, Shot, find_picture, note_smaller
from pansplat.system.descriptions import describe_count
from pansplat.system.files import read_file

_MAX_BYTES = 1 << 28  # of a file
_HEAD = 4096  # bytes that show what a file is


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
    """The aligned cameras of spherical sensors; of several components, those of the largest, with a note.

    Args:
        source: the file.
        folder: of the file.
        convention: of the poses; by default "cam2world opencv".
    """
    data = read_file(source, limit=_MAX_BYTES)
    if b"<!DOCTYPE" in data[:_HEAD] or b"<!ENTITY" in data:
        raise InputError(f"{source}: needed XML of Metashape, got definitions of entities; export it again.")
    try:
        document = ElementTree.fromstring(data)
        chunk = document.find("chunk")
        if chunk is None:
            raise ValueError("no chunk")
        sensors = {sensor.get("id") for sensor in chunk.iter("sensor") if sensor.get("type") == "spherical"}
        rotation, scale, is_metric = _read_chunk_transform(chunk)
        transforms = {component.get("id"): _read_chunk_transform(component) for component in chunk.iter("component")}
        cameras = [camera for camera in chunk.iter("camera") if camera.find("transform") is not None]
        spherical = [camera for camera in cameras if camera.get("sensor_id") in sensors]
        sizes = Counter(camera.get("component_id") for camera in spherical)
        largest = max(sizes, key=sizes.__getitem__, default=None)
        own, factor, has_scale = transforms.get(largest, (rotation, scale, is_metric))
        if has_scale:
            rotation, scale, is_metric = own, factor, True
        shots, missing = [], []
        for camera in spherical:
            if camera.get("component_id") != largest:
                continue
            name = camera.get("label", "")
            image = find_picture(folder, name)
            if image is None:
                missing.append(name)
                continue
            matrix = np.array((camera.findtext("transform") or "").split(), np.float64).reshape(4, 4)
            pose = to_cam2world(
                rigid_matrix(matrix.tolist(), f"{source}, {name!r}"), convention or "cam2world opencv"
            ).clone()
            pose[:3] = torch.from_numpy(rotation) @ pose[:3]
            pose[:3, 3] *= scale
            shots.append(Shot(name, image, pose))
    except (ElementTree.ParseError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source}: needed cameras exported by Metashape, got another content ({error}); use File > Export > "
            "Export Cameras, Agisoft XML."
        ) from error
    if not spherical:
        raise InputError(
            f"{source}: needed aligned cameras of a spherical sensor, got "
            f"{describe_count(len(cameras), 'aligned camera')} and {describe_count(len(sensors), 'spherical sensor')}; "
            "set the camera type to Spherical and align, or move the file away to estimate poses."
        )
    note_smaller(source, len(sizes) - 1)
    return Reconstruction(source, folder, shots, is_metric=is_metric, missing=missing)


def _read_chunk_transform(element: ElementTree.Element) -> tuple[np.ndarray, float, bool]:
    """Rotation and scale of a chunk or component, and whether it has a scale."""
    transform = element.find("transform")
    rotation = None if transform is None else transform.findtext("rotation")
    scale = None if transform is None else transform.findtext("scale")
    matrix = np.eye(3) if not rotation else np.array(rotation.split(), np.float64).reshape(3, 3)
    factor = 1.0 if not scale else float(scale)
    pose = np.eye(4)
    pose[:3, :3] = matrix
    if not 0 < factor < float("inf"):
        raise ValueError(f"scale {factor}")
    return rigid_matrix(pose.tolist(), "the transform of the chunk")[:3, :3].numpy(), factor, bool(scale)
