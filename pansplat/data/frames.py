"""Long sequences of posed panoramas, of which a few frames are read at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.data.collection import FAR_SEQUENCE, NEAR
from pansplat.data.pair import Pair, Panorama
from pansplat.data.sample import Sample
from pansplat.data.samplers import Draw
from pansplat.data.views import Views


@runtime_checkable
class FrameSequence(Protocol):
    """A sequence of posed panoramas; `poses` are cam2world in OpenCV axes, metres."""

    @property
    def name(self) -> str: ...

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]: ...

    def read(self, frames: Sequence[int], height: int) -> Views:
        """Those frames at (height, 2 height), in the order asked for."""
        ...


@dataclass(frozen=True, eq=False)
class PictureSequence:
    """Frames that are picture files. Without a mask file beside a picture the whole picture counts as scene."""

    name: str
    panoramas: tuple[Panorama, ...]
    near: float = NEAR
    far: float = FAR_SEQUENCE

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]:
        return [panorama.cam2world for panorama in self.panoramas]

    def read(self, frames: Sequence[int], height: int) -> Views:
        """Those frames at (height, 2 height), in the order asked for.

        Raises:
            InputError: a picture, mask or depth file cannot be used.
        """
        chosen = tuple(self.panoramas[frame] for frame in frames)
        first = chosen[0].image
        return Pair(self.name, first.parent, (), chosen, self.near, self.far).load_targets(height)


def read_draw(sequence: FrameSequence, draw: Draw, height: int) -> Sample:
    """The sample of a draw; each frame is read once, also where a target is an input."""
    frames = sorted({draw.left, draw.right, *draw.targets})
    views = sequence.read(frames, height)
    where = {frame: i for i, frame in enumerate(frames)}
    name = f"{sequence.name}-{draw.left:06d}-{draw.right:06d}"
    return Sample(
        name,
        select_views(views, [where[draw.left], where[draw.right]]),
        select_views(views, [where[frame] for frame in draw.targets]),
    )


def select_views(views: Views, indices: Sequence[int]) -> Views:
    """Some of the views, in the order of `indices`."""
    chosen = torch.tensor(list(indices), dtype=torch.long)
    return Views(
        images=views.images[chosen],
        cam2world=views.cam2world[chosen],
        masks=views.masks[chosen],
        near=views.near,
        far=views.far,
        names=tuple(views.names[i] for i in indices),
        depths=None if views.depths is None else views.depths[chosen],
    )
