"""Training data without files: triplets of panoramas of the furnished room of the benchmarks, with exact depth.

Each triplet has its own proportions of the room, colours, patterns and cameras. Equal seeds and indices give equal
triplets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pansplat.bench.scenes import NUM_SURFACES, trace_room
from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.panorama_sets import FAR, NEAR
from pansplat.inputs.views import Sample, Views

_FREE_BOX = ((-2.0, -0.6, -1.7), (1.9, 0.6, 0.8))  # metres; corners of a box that is half a metre from all surfaces
_STRETCH = (0.9, 1.4)  # range of the factors of the room's size along each axis
_BASELINE = (0.3, 2.0)  # metres; range of the distance between the two inputs
_WAVE_NUMBERS = (4.0, 25.0)  # radians per metre; range of the patterns' wave numbers
_RAYS = 2  # rays along each side of a pixel


@dataclass(frozen=True)
class RoomTriplets:
    """A `SampleSource` of rooms.

    Attributes:
        seed: seed of the random rooms.
        count: samples per epoch; larger indices are valid too.
    """

    seed: int = 0
    count: int = 10_000

    def __len__(self) -> int:
        return self.count

    def sample(self, index: int, height: int, seed: int = 0) -> Sample:
        """Triplet `index`; `seed` has no effect."""
        room = _Room(np.random.default_rng((self.seed, index)))
        name = f"room_{self.seed}_{index:06d}"
        context, target = (
            room.render(places, height, tuple(f"{name}_{n}" for n in numbers))
            for places, numbers in ((room.places[[0, 2]], (0, 2)), (room.places[1:2], (1,)))
        )
        return Sample(name, context, target)


class _Room:
    """A room with random proportions and colours, and the places of a triplet's cameras.

    Attributes:
        places: (3 3) of the first input, the target and the second input, metres, float64.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._stretch = torch.from_numpy(rng.uniform(*_STRETCH, 3))
        self.places = torch.from_numpy(_sample_places(self._stretch.numpy(), rng))
        self._colors = torch.from_numpy(rng.uniform(0.25, 0.75, (NUM_SURFACES, 3)))
        self._contrast = torch.from_numpy(rng.uniform(-0.25, 0.25, (NUM_SURFACES, 3)))
        directions = rng.normal(size=(NUM_SURFACES, 2, 3))
        lengths = np.exp(rng.uniform(*np.log(_WAVE_NUMBERS), (NUM_SURFACES, 2, 1)))
        self._waves = torch.from_numpy(lengths * directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def render(self, places: Float[Tensor, "view 3"], height: int, names: tuple[str, ...]) -> Views:
        """Upright panoramas (height, 2 height) with exact radial depth."""
        poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
        poses[:, :3, 3] = places
        images = torch.stack([self._trace(place, _RAYS * height)[0] for place in places])
        return Views(
            images=avg_pool2d(images, _RAYS).float(),
            cam2world=poses,
            masks=torch.ones(len(places), height, 2 * height, dtype=torch.bool),
            near=NEAR,
            far=FAR,
            names=names,
            depths=torch.stack([self._trace(place, height)[1] for place in places]).float(),
        )

    def _trace(self, place: Float[Tensor, "3"], height: int) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
        """RGB in [0, 1] and radial depth in metres along the rays through the centres of pixels."""
        rays = pixel_directions(height, 2 * height, dtype=torch.float64).reshape(-1, 3)
        distance, _, surface = trace_room(rays / self._stretch, place / self._stretch)
        points = place + distance[:, None] * rays
        pattern = torch.einsum("nwd,nd->nw", self._waves[surface], points).sin().prod(dim=1)
        colors = self._colors[surface] + self._contrast[surface] * pattern[:, None]
        return colors.T.reshape(3, height, 2 * height), distance.reshape(height, 2 * height)


def _sample_places(stretch: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Three places (3 3) in the free space of a room; the second is near the middle of the others."""
    low, high = np.array(_FREE_BOX) * stretch
    while True:
        start, direction = rng.uniform(low, high), rng.normal(size=3) * (1, 0.1, 1)
        length = rng.uniform(*_BASELINE)
        end = start + length * direction / np.linalg.norm(direction)
        middle = start + rng.uniform(0.35, 0.65) * (end - start) + rng.normal(0, 0.04 * length, size=3)
        places = np.stack((start, middle, end))
        if (places >= low).all() and (places <= high).all():
            return places
