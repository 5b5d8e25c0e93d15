"""Flights through generated homes: two panoramas and what a camera sees on the way, to measure what is predicted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pansplat.images.image_files import write_depth, write_image
from pansplat.system.atomic import replacing
from pansplat_homes.camera import CameraEffects, photograph
from pansplat_homes.homes import Furnishing, Home, build_home, make_pose
from pansplat_homes.plans import RoomKind

NAMES = ("start", "quarter", "half", "three_quarters", "end")
_LENGTH = (1.5, 4.0)  # metres
_CLEARANCE = 0.25  # least distance of a flight to a body, metres
_LEAST_AREA = 5.0  # of a room, square metres
_ATTEMPTS = 400  # random places in a home before the next home is tried
# Nothing is fixed to the camera: on the way there is no camera.
_EFFECTS = CameraEffects(jpeg_quality=None, nadir_probability=0.0, zenith_probability=0.0, operator_probability=0.0)


def write_flight(folder: Path, seed: tuple[int, int], height: int, samples: int = 2) -> float:
    """Write `NAMES`.png of one flight with poses.json, pairs.json and the depth of the targets; its length in metres.

    Flights of even numbers stay in a room, those of odd ones go to a neighbouring one. The homes are furnished. A
    folder with a pairs.json is complete and kept.

    Args:
        seed: of all flights, and the number of this one.
        height: of the panoramas, pixels.
        samples: `samples` squared is the number of rays per pixel.
    """
    if not (folder / "pairs.json").exists():
        rng, number = np.random.default_rng(seed), seed[1]
        ends = None
        while ends is None:
            home = build_home(rng)
            ends = _sample_ends(home, rng, steps=number % 2) if home.furnishing >= Furnishing.FURNISHED else None
        yaw = rng.uniform(0, 2 * np.pi)
        poses = [make_pose(ends[0] + share * (ends[1] - ends[0]), yaw) for share in np.linspace(0, 1, len(NAMES))]
        views = [home.variants[0].panorama(pose, height, samples) for pose in poses]
        light, depth = (np.stack([view[n] for view in views]).astype(np.float32) for n in (0, 1))
        _write(folder, photograph(light, depth, rng, _EFFECTS).images, depth, poses)
    stated = json.loads((folder / "poses.json").read_text("utf-8"))["poses"]
    first, last = (np.array(stated[f"{name}.png"]["cam2world"])[:3, 3] for name in (NAMES[0], NAMES[-1]))
    return float(np.linalg.norm(last - first))


def _sample_ends(home: Home, rng: np.random.Generator, steps: int) -> NDArray[np.float64] | None:
    """Two places (2 3) with free space between them, in rooms that `steps` passages connect; None if none was found."""
    plan = home.plan
    rooms = [n for n, room in enumerate(plan.rooms) if room.kind != RoomKind.CLOSET and room.area > _LEAST_AREA]
    for _ in range(_ATTEMPTS if rooms else 0):
        first = int(rng.choice(rooms))
        reached = [n for n in rooms if plan.steps_from(first)[n] == steps]
        if not reached:
            continue
        ends = []
        for room in (first, int(rng.choice(reached))):
            x0, z0, x1, z1 = plan.interior(room)
            x, z = rng.uniform(0.2, 0.8, 2)
            ends.append((x0 + x * (x1 - x0), -home.camera_height, z0 + z * (z1 - z0)))
        places = np.array(ends)
        is_long = _LENGTH[0] <= np.linalg.norm(places[1] - places[0]) <= _LENGTH[1]
        if is_long and home.variants[0].clearance(np.linspace(*places, 40)).min() >= _CLEARANCE:
            return places
    return None


def _write(
    folder: Path, images: NDArray[np.float32], depths: NDArray[np.float32], poses: list[NDArray[np.float64]]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    entries = {}
    for name, image, depth, pose in zip(NAMES, images, depths, poses, strict=True):
        write_image(folder / f"{name}.png", image, panorama="photograph")
        write_depth(folder / f"{name}_depth.png", depth, panorama=False)
        entries[f"{name}.png"] = {"cam2world": pose.tolist(), "depth": f"{name}_depth.png"}
    first, *middle, last = (f"{name}.png" for name in NAMES)
    contents = {
        "poses.json": {"convention": "cam2world opencv", "poses": entries},
        "pairs.json": {"pairs": [{"name": folder.name, "context": [first, last], "target": middle}]},
    }
    for name, content in contents.items():
        with replacing(folder / name) as partial:
            partial.write_text(json.dumps(content, indent=1), "utf-8")
