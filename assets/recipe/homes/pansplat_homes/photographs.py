"""Generated homes as folders of photographs with known poses: what an agent's tour of a home is, for the pose bench."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from pansplat.system.atomic import replacing
from pansplat_homes.camera import CameraEffects, photograph
from pansplat_homes.homes import build_home
from pansplat_homes.library import FurnitureLibrary

_LEAST = 3  # photographs of a home
_JPEG_QUALITY = 92
_EFFECTS = CameraEffects(jpeg_quality=None)  # the files are compressed once


def write_home(
    folder: Path, seed: tuple[int, int], height: int, library: FurnitureLibrary | None = None, samples: int = 2
) -> int:
    """Write `NN.jpg` of one home, one or two a room, and their poses.json, and return the number of photographs.

    A folder with a poses.json is complete and kept.

    Args:
        seed: of all homes, and the number of this one.
        height: of the panoramas, pixels.
        samples: `samples` squared is the number of rays per pixel.
    """
    poses_file = folder / "poses.json"
    if poses_file.exists():
        return len(json.loads(poses_file.read_text("utf-8"))["poses"])
    rng = np.random.default_rng(seed)
    cameras = []
    while len(cameras) < _LEAST:
        home = build_home(rng, library)
        cameras = home.sample_room_cameras(rng)
    views = [home.variants[variant].panorama(pose, height, samples) for variant, pose in cameras]
    light, depth = (np.stack([view[n] for view in views]).astype(np.float32) for n in (0, 1))
    images = photograph(light, depth, rng, _EFFECTS).images
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for number, (image, (_, pose)) in enumerate(zip(images, cameras, strict=True)):
        pixels = np.rint(image[..., ::-1].clip(0, 1) * 255).astype(np.uint8)
        encoded = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1]
        with replacing(folder / f"{number:02d}.jpg") as partial:
            partial.write_bytes(encoded.tobytes())
        poses[f"{number:02d}.jpg"] = pose.tolist()
    with replacing(poses_file) as partial:
        partial.write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}, indent=1), "utf-8")
    return len(cameras)
