"""Cameras, rendering and export of the sample: equirectangular colour, radial depth and poses.

The export converts Blender's world (x east, y north, z up) to x east, y down, z north, and its camera axes (x right,
y up, z backward) to OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import bpy
import numpy as np
from furniture import Credit
from mathutils import Matrix
from PIL import Image

# Name: (x, y, z) in metres; yaw (counter-clockwise from north), pitch (up) and roll in degrees.
VIEWS = {
    "left": ((-0.5, -0.3, 1.5), (14.0, 1.5, -1.0)),
    "middle": ((0.0, -0.3, 1.5), (0.0, 0.0, 0.0)),
    "right": ((0.5, -0.3, 1.5), (-22.0, -1.0, 2.0)),
}
NEAR, FAR = 0.45, 12.0
_JPEG_QUALITY = 92
_WORLD = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
_CAMERA = np.diag([1.0, -1.0, -1.0])


def blender_rotation(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Camera-to-world rotation in Blender's axes; angles in degrees, zero angles are level and face north."""
    y, p, r = (math.radians(a) for a in (yaw, pitch, roll))
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    tilt = math.pi / 2 + p
    about_x = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    about_view = np.array([[math.cos(r), -math.sin(r), 0], [math.sin(r), math.cos(r), 0], [0, 0, 1]])
    return about_z @ about_x @ about_view


def cam2world(position: Sequence[float], angles: Sequence[float]) -> np.ndarray:
    """Pose for poses.json: OpenCV axes, world with y down."""
    pose = np.eye(4)
    pose[:3, :3] = _WORLD @ blender_rotation(*angles) @ _CAMERA
    pose[:3, 3] = _WORLD @ np.array(position)
    return pose


def _add_camera() -> bpy.types.Object:
    data = bpy.data.cameras.new("panorama")
    data.type, data.clip_start, data.clip_end = "PANO", 0.01, 100.0
    data.panorama_type = "EQUIRECTANGULAR"
    item = bpy.data.objects.new("panorama", data)
    bpy.context.scene.collection.objects.link(item)
    bpy.context.scene.camera = item
    return item


def _set_height(height: int) -> None:
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 2 * height, height, 100


def _configure_cycles(samples: int, threads: int) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.use_persistent_data = True
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", samples, 1
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.02
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "ACCURATE"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 5, 5, 2
    cycles.transmission_bounces, cycles.transparent_max_bounces = 2, 12
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 4.0
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.view_settings.exposure = 1.45
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.view_layers[0].use_pass_z = True


def _render_color(path: Path) -> np.ndarray:
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return np.asarray(Image.open(path).convert("RGB"))


def _render_depth(folder: Path) -> np.ndarray:
    """Distance along the ray through each pixel's centre, rendered with one sample and a very narrow pixel filter."""
    scene, cycles = bpy.context.scene, bpy.context.scene.cycles
    names = ("samples", "use_denoising", "pixel_filter_type", "filter_width", "max_bounces")
    saved = {name: getattr(cycles, name) for name in names}
    cycles.samples, cycles.use_denoising, cycles.max_bounces = 1, False, 0
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 0.01
    scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    layers, output = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeOutputFile")
    output.base_path, output.file_slots[0].path = str(folder), "depth_"
    output.format.file_format, output.format.color_mode, output.format.color_depth = "OPEN_EXR", "RGB", "32"
    links.new(layers.outputs["Depth"], output.inputs[0])
    bpy.ops.render.render()
    scene.use_nodes = False
    for name, value in saved.items():
        setattr(cycles, name, value)
    image = bpy.data.images.load(str(folder / f"depth_{scene.frame_current:04d}.exr"))
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    depth = pixels.reshape(image.size[1], image.size[0], image.channels)[::-1, :, 0].copy()
    bpy.data.images.remove(image)
    return depth


def _save(image: Image.Image, path: Path, **options: object) -> None:
    part = path.with_name(f".part-{path.name}")
    image.save(part, **options)
    os.replace(part, path)


def _write_json(path: Path, content: object) -> None:
    part = path.with_name(f".part-{path.name}")
    part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(part, path)


def render_all(
    out: Path, views: Sequence[str], heights: tuple[int, int], samples: int, threads: int, scratch: Path
) -> None:
    """Render the named views and write the pair's folder; `heights` are those of colour and of depth, pixels."""
    out.mkdir(parents=True, exist_ok=True)
    _configure_cycles(samples, threads)
    camera = _add_camera()
    poses = {}
    for name in views:
        position, angles = VIEWS[name]
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = blender_rotation(*angles), position
        camera.matrix_world = Matrix(matrix.tolist())
        _set_height(heights[1])
        depth = _render_depth(scratch)
        _set_height(heights[0])
        color = _render_color(scratch / f"{name}.png")
        millimetres = np.where(depth < 65.5, np.rint(depth * 1000), 0).astype(np.uint16)
        _save(Image.fromarray(millimetres), out / f"{name}_depth.png", optimize=True)
        _save(Image.fromarray(color), out / f"{name}.jpg", quality=_JPEG_QUALITY, optimize=True)
        print(f"{name}: depth {depth.min():.3f} to {depth.max():.3f} m", flush=True)
    for name, (position, angles) in VIEWS.items():
        pose = np.round(cam2world(position, angles), 15) + 0.0
        poses[f"{name}.jpg"] = {"cam2world": pose.tolist(), "depth": f"{name}_depth.png"}
    _write_json(out / "poses.json", {"convention": "cam2world opencv", "near": NEAR, "far": FAR, "poses": poses})
    _write_json(out / "pairs.json", {"pairs": [{"context": ["left.jpg", "right.jpg"], "target": ["middle.jpg"]}]})


def write_credits(path: Path, credits: Iterable[Credit]) -> None:
    """Write the models in the room, their authors and licences."""
    _write_json(path, [asdict(c) for c in sorted(credits, key=lambda c: c.model.lower())])
