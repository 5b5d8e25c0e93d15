"""Triplets of panoramas of random generated homes, with exact depth, as training data.

Each home has its own plan, furniture, materials and lights. Equal seeds and indices give equal triplets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pansplat.images.image_files import srgb_from_linear, write_depth, write_image
from pansplat.inputs.panorama_sets import FAR, NEAR
from pansplat.inputs.views import Sample, Views
from pansplat.system.atomic import replacing
from pansplat_homes.homes import Home, build_home
from pansplat_homes.plans import OUTSIDE
from pansplat_homes.scene import GeneratedScene

Array = NDArray[np.float64]

_CLEARANCE = NEAR  # least distance of the cameras' path to a body, metres
_MAX_ATTEMPTS = 60  # random places in a home before another home is generated


@dataclass(frozen=True)
class GeneratedTriplets:
    """Triplets by index.

    Attributes:
        seed: seed of the homes.
        baseline: smallest and largest distance between the two context cameras, metres.
        samples: `samples` squared is the number of rays per pixel.
    """

    seed: int = 0
    baseline: tuple[float, float] = (0.3, 2.0)
    samples: int = 2

    def name(self, index: int) -> str:
        """Name of a triplet."""
        return f"generated_{self.seed}_{index:06d}"

    def sample(self, index: int, height: int) -> Sample:
        """Triplet `index`, at (height, 2 height)."""
        rng = np.random.default_rng((self.seed, index))
        scene, poses = self._sample_home(rng)
        renderings = [scene.panorama(pose, height, self.samples) for pose in poses]
        exposure = _sample_exposure([light for light, _ in renderings], rng)
        images = [torch.from_numpy(srgb_from_linear(exposure * light)).permute(2, 0, 1) for light, _ in renderings]
        depths = [torch.from_numpy(depth).float() for _, depth in renderings]
        name = self.name(index)
        context, targets = (
            Views(
                images=torch.stack([images[i] for i in chosen]).contiguous(),
                cam2world=torch.from_numpy(np.stack([poses[i] for i in chosen])),
                masks=torch.ones(len(chosen), height, 2 * height, dtype=torch.bool),
                near=NEAR,
                far=FAR,
                names=tuple(f"{name}_{i}" for i in chosen),
                depths=torch.stack([depths[i] for i in chosen]),
            )
            for chosen in ((0, 2), (1,))
        )
        return Sample(name, context, targets)

    def _sample_home(self, rng: np.random.Generator) -> tuple[GeneratedScene, list[Array]]:
        """A home with enough free space for the cameras, and their poses."""
        while True:
            home = build_home(rng)
            poses = _sample_poses(home, self.baseline, rng)
            if poses is not None:
                return home.variants[0], poses


def write_triplet(folder: Path, seed: int, index: int, height: int) -> None:
    """Write triplet `index` as a training source of `--data.kind triplets`: NAME_N.png, NAME_N_depth.png, NAME.json.

    A triplet with a NAME.json is complete and kept.
    """
    source = GeneratedTriplets(seed)
    file = folder / f"{source.name(index)}.json"
    if file.exists():
        return
    sample = source.sample(index, height)
    context, target = sample.context, sample.targets
    assert context.depths is not None and target.depths is not None
    folder.mkdir(parents=True, exist_ok=True)
    for number, (views, n) in enumerate(((context, 0), (target, 0), (context, 1))):
        write_image(file.with_name(f"{file.stem}_{number}.png"), views.images[n], panorama=True)
        write_depth(file.with_name(f"{file.stem}_{number}_depth.png"), views.depths[n], panorama=False)
    poses = (context.cam2world[0], target.cam2world[0], context.cam2world[1])
    with replacing(file) as partial:
        partial.write_text(json.dumps({"c2w": [pose.tolist() for pose in poses]}), "utf-8")


def _sample_poses(home: Home, baseline: tuple[float, float], rng: np.random.Generator) -> list[Array] | None:
    """Poses of the first input, the target and the second input, on a free path; None if none was found."""
    yaw, length = rng.uniform(0, 2 * np.pi), rng.uniform(*baseline)
    rotation = np.array(((np.cos(yaw), 0, np.sin(yaw)), (0, 1, 0), (-np.sin(yaw), 0, np.cos(yaw))))
    rooms = [room for room in home.plan.rooms if min(room.width, room.depth) > 2 * _CLEARANCE]
    for _ in range(_MAX_ATTEMPTS):
        if not rooms:
            break
        room = rooms[rng.integers(len(rooms))].corners
        x, z = (rng.uniform(room[k] + _CLEARANCE, room[k + 2] - _CLEARANCE) for k in (0, 1))
        start = np.array((x, -rng.uniform(0.9, 1.8), z))
        azimuth = rng.uniform(0, 2 * np.pi)
        direction = np.array((np.sin(azimuth), rng.normal(0, 0.05), np.cos(azimuth)))
        end = start + length * direction / np.linalg.norm(direction)
        middle = start + rng.uniform(0.35, 0.65) * (end - start) + rng.normal(0, 0.04 * length, size=3)
        if not -2.1 < end[1] < -0.5 or home.plan.room_at(end[0], end[2]) == OUTSIDE:
            continue
        path = np.concatenate((np.linspace(start, middle, 8), np.linspace(middle, end, 8)))
        if home.variants[0].clearance(path).min() < _CLEARANCE:
            continue
        poses = []
        for centre in (start, middle, end):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, centre
            poses.append(pose)
        return poses
    return None


def _sample_exposure(renderings: list[Array], rng: np.random.Generator) -> float:
    """A random exposure for all views that maps the median brightness to about mid-grey."""
    middle = float(np.median(np.stack(renderings).mean(axis=-1)))
    return rng.uniform(0.14, 0.34) / max(middle, 1e-3)
