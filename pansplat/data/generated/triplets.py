"""Training data without files: triplets of panoramas of generated homes, as many as one wants, with exact depth.

Each home has its own plan, furniture, surfaces, colours and light. The same seed and number give the same picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pansplat.data.generated.homes import Plan, build_home
from pansplat.data.generated.scene import GeneratedScene
from pansplat.data.images import srgb_from_linear
from pansplat.data.pairs import FAR, NEAR
from pansplat.data.views import Sample, Views

Array = NDArray[np.float64]

_CLEARANCE = NEAR  # metres from the cameras' path to the nearest thing
_PLACES = 60  # tried in a home before another one is built


@dataclass(frozen=True)
class GeneratedTriplets:
    """An endless source of triplets; `count` is what counts as an epoch.

    Attributes:
        seed: another seed gives other homes.
        count: samples an epoch; numbers beyond it give more.
        baseline: smallest and largest distance between the two input cameras, metres.
        samples: rays a pixel are `samples` squared.
    """

    seed: int = 0
    count: int = 10_000
    baseline: tuple[float, float] = (0.3, 2.0)
    samples: int = 2

    def __len__(self) -> int:
        return self.count

    def sample(self, index: int, height: int, seed: int = 0) -> Sample:
        """The triplet of that number; `seed` has no part in it."""
        rng = np.random.default_rng((self.seed, index))
        scene, poses = self._home(rng)
        pictures = [scene.panorama(pose, height, self.samples) for pose in poses]
        exposure = _exposure([light for light, _ in pictures], rng)
        images = [torch.from_numpy(srgb_from_linear(exposure * light)).permute(2, 0, 1) for light, _ in pictures]
        depths = [torch.from_numpy(depth).float() for _, depth in pictures]
        name = f"generated_{self.seed}_{index:06d}"
        order = ((0, 2), (1,))
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
            for chosen in order
        )
        return Sample(name, context, targets)

    def _home(self, rng: np.random.Generator) -> tuple[GeneratedScene, list[Array]]:
        """A home in which there is room for the cameras, and their poses."""
        while True:
            scene, plan = build_home(rng)
            poses = _triplet(scene, plan, self.baseline, rng)
            if poses is not None:
                return scene, poses


def _triplet(
    scene: GeneratedScene, plan: Plan, baseline: tuple[float, float], rng: np.random.Generator
) -> list[Array] | None:
    """Poses of an input, the target and the other input, on a free path; None where no place was found."""
    yaw, length = rng.uniform(0, 2 * np.pi), rng.uniform(*baseline)
    rotation = np.array(((np.cos(yaw), 0, np.sin(yaw)), (0, 1, 0), (-np.sin(yaw), 0, np.cos(yaw))))
    for _ in range(_PLACES):
        room = plan.rooms[rng.integers(len(plan.rooms))]
        x, z = (rng.uniform(room[k] + _CLEARANCE, room[k + 2] - _CLEARANCE) for k in (0, 1))
        start = np.array((x, -rng.uniform(0.9, 1.8), z))
        around = rng.uniform(0, 2 * np.pi)
        way = np.array((np.sin(around), rng.normal(0, 0.05), np.cos(around)))
        end = start + length * way / np.linalg.norm(way)
        middle = start + rng.uniform(0.35, 0.65) * (end - start) + rng.normal(0, 0.04 * length, size=3)
        if not _inside(end, plan):
            continue
        path = np.concatenate((np.linspace(start, middle, 8), np.linspace(middle, end, 8)))
        if scene.clearance(path).min() < _CLEARANCE:
            continue
        poses = []
        for centre in (start, middle, end):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, centre
            poses.append(pose)
        return poses
    return None


def _inside(point: Array, plan: Plan) -> bool:
    x0, z0, x1, z1 = plan.whole
    return bool(x0 < point[0] < x1 and z0 < point[2] < z1 and -2.1 < point[1] < -0.5)


def _exposure(pictures: list[Array], rng: np.random.Generator) -> float:
    """One factor for all views, as a camera with fixed exposure has: the middle of the tones lands near mid-grey."""
    middle = float(np.median(np.stack(pictures).mean(axis=-1)))
    return rng.uniform(0.14, 0.34) / max(middle, 1e-3)
