"""Panoramas on disk with their poses, read when asked for."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.data.images import read_depth, read_mask, read_panorama
from pansplat.data.masks import static_mask_of_files
from pansplat.data.views import Views
from pansplat.errors import InputError

_COINCIDENT = 1e-3  # metres


@dataclass(frozen=True, eq=False)
class Panorama:
    """One panorama file with its pose.

    Attributes:
        name: the file's stem, or the view's folder where all files have one name.
        image: JPG, PNG, WebP or EXR file.
        cam2world: float64, OpenCV axes, metres.
        mask: picture that is white where the panorama shows the scene; None to detect it.
        depth: 16-bit PNG in millimetres or EXR in metres, radial; None where the data set has none.
    """

    name: str
    image: Path
    cam2world: Float[Tensor, "4 4"]
    mask: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True, eq=False)
class Pair:
    """Panoramas to predict a scene from, and those to compare it with. Nothing is read until asked for.

    Attributes:
        name: unique among the pairs loaded together; fit for a file name.
        folder: where its files are.
        context: two or more panoramas, the predictor's input.
        targets: panoramas for comparison, maybe none.
        near, far: radial depth range to search, metres.
        siblings: all panoramas taken with the same camera, from which static content is detected.
    """

    name: str
    folder: Path
    context: tuple[Panorama, ...]
    targets: tuple[Panorama, ...]
    near: float
    far: float
    siblings: tuple[Path, ...] = field(default=(), repr=False)

    def load_context(self, height: int) -> Views:
        """The context panoramas at (height, 2 height); warns when two of their cameras coincide.

        Raises:
            InputError: a picture, mask or depth file cannot be used.
        """
        centres = torch.stack([panorama.cam2world[:3, 3] for panorama in self.context])
        if float(torch.pdist(centres).min()) < _COINCIDENT:
            warnings.warn(
                f"{self.name}: cameras of the context views coincide (less than "
                f"{1000 * _COINCIDENT:.0f} mm apart); "
                "without a baseline depth cannot be measured and the scene holds for turning only. "
                "Check the poses if the cameras did move.",
                stacklevel=2,
            )
        return self._load(self.context, height)

    def load_targets(self, height: int) -> Views:
        """The target panoramas at (height, 2 height); no view when the pair has none.

        Raises:
            InputError: a picture, mask or depth file cannot be used.
        """
        return self._load(self.targets, height)

    def _load(self, panoramas: tuple[Panorama, ...], height: int) -> Views:
        images = torch.empty(len(panoramas), 3, height, 2 * height)
        masks = torch.empty(len(panoramas), height, 2 * height, dtype=torch.bool)
        for i, panorama in enumerate(panoramas):
            images[i], opaque = read_panorama(panorama.image, height)
            masks[i] = opaque & self._scene_mask(panorama, height)
            if not masks[i].any():
                raise InputError(
                    f"{panorama.mask or panorama.image}: needed some pixels that show the scene (white in a mask, "
                    "opaque in a picture), got none; invert the mask or remove the alpha channel."
                )
        depths = [read_depth(p.depth, height) for p in panoramas if p.depth is not None]
        return Views(
            images=images,
            cam2world=torch.stack([p.cam2world for p in panoramas]) if panoramas else _no_poses(),
            masks=masks,
            near=self.near,
            far=self.far,
            names=tuple(p.name for p in panoramas),
            depths=torch.stack(depths) if depths and len(depths) == len(panoramas) else None,
        )

    def _scene_mask(self, panorama: Panorama, height: int) -> Bool[Tensor, "height width"]:
        """The user's mask, whose word is final, or else what does not travel with the camera."""
        if panorama.mask is not None:
            return read_mask(panorama.mask, height)
        return static_mask_of_files(self.siblings, height)


def _no_poses() -> Float[Tensor, "0 4 4"]:
    return torch.empty(0, 4, 4, dtype=torch.float64)
