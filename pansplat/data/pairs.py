"""Posed panoramas on disk, grouped into pairs of context and target views."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.data.images import READABLE_SUFFIXES, read_depth, read_mask, read_panorama
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


NEAR, FAR = 0.45, 10.0  # metres; the depth range of the original system's indoor data (OFFICIAL.md 2.1)
FAR_SEQUENCE = 50.0  # and of its halls and outdoor videos (OFFICIAL.md 2.2, 2.3)

Case = tuple[tuple[int, ...], tuple[int, ...]]  # indices of the context and of the targets


@dataclass(frozen=True, eq=False)
class Collection:
    """All posed panoramas of a folder.

    Attributes:
        source: file or folder that messages point at.
        panoramas: in file order.
        cases: which are context and targets; None to choose by distance or order.
        ordered: whether the order is a path, so that neighbours in it make pairs.
        near, far: metres.
        name: of the only case; None for names made of the views'.
    """

    source: Path
    panoramas: tuple[Panorama, ...]
    cases: tuple[Case, ...] | None = None
    ordered: bool = False
    near: float = NEAR
    far: float = FAR
    name: str | None = None

    def pairs(self, folder: Path, near: float | None = None, far: float | None = None) -> list[Pair]:
        """One pair a case, those with targets first; `near` and `far` (metres) go before the folder's own.

        Raises:
            InputError: fewer than two panoramas, or a depth range that is none.
        """
        if len(self.panoramas) < 2:
            raise InputError(
                f"{self.source}: needed two or more posed panoramas, got {len(self.panoramas)}; "
                "add the other panorama and its pose."
            )
        near, far = self.near if near is None else near, self.far if far is None else far
        if not 0 < near < far < math.inf:
            raise InputError(
                f"{self.source}: needed 0 < near < far in metres, got near={near:g} and far={far:g}; "
                'set "near" and "far" in poses.json or on the command line.'
            )
        siblings = tuple(panorama.image for panorama in self.panoramas)
        pairs = []
        for context, targets in self.chosen_cases():
            views = [self.panoramas[i] for i in context]
            name = self.name or "-".join(view.name for view in views)
            chosen = tuple(self.panoramas[i] for i in targets)
            pairs.append(Pair(name, folder, tuple(views), chosen, near, far, siblings))
        return pairs

    def chosen_cases(self) -> list[Case]:
        """The given cases, those with targets first and no context twice; else neighbours."""
        if self.cases is None:
            return [(pair, ()) for pair in self._neighbours()]
        with_targets = [case for case in self.cases if case[1]]
        seen = {frozenset(context) for context, _ in with_targets}
        plain = []
        for case in self.cases:
            key = frozenset(case[0])
            if not case[1] and key not in seen:
                seen.add(key)
                plain.append(case)
        return with_targets + plain

    def _neighbours(self) -> list[tuple[int, int]]:
        """Neighbours along the path, or the edges of the minimum spanning tree of the camera centres.

        The tree pairs each panorama with a near one, uses all of them and no pair twice.
        """
        count = len(self.panoramas)
        if self.ordered or count == 2:
            return [(i, i + 1) for i in range(count - 1)]
        centres = torch.stack([panorama.cam2world[:3, 3] for panorama in self.panoramas])
        distance = (centres - centres[0]).norm(dim=-1)  # Prim's algorithm from the first panorama
        parent = torch.zeros(count, dtype=torch.long)
        outside = torch.ones(count, dtype=torch.bool)
        outside[0] = False
        edges = []
        while outside.any():
            new = int(torch.where(outside, distance, torch.inf).argmin())
            edges.append(tuple(sorted((int(parent[new]), new))))
            outside[new] = False
            there = (centres - centres[new]).norm(dim=-1)
            parent[there < distance] = new
            distance = torch.minimum(distance, there)
        return sorted(edges)


def mask_beside(image: Path, folder: Path) -> Path | None:
    """The mask of a picture: STEM_mask.png beside it, or mask.png beside it or in the collection's folder."""
    for mask in (image.with_name(f"{image.stem}_mask.png"), image.with_name("mask.png"), folder / "mask.png"):
        if mask.is_file():
            return mask
    return None


def pictures_in(folder: Path) -> list[Path]:
    """Panorama files of a folder by name, without masks and depth."""
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in READABLE_SUFFIXES
        and path.stem not in ("mask", "depth")
        and not path.stem.endswith(("_mask", "_depth"))
        and not path.name.startswith(".")
        and path.is_file()
    ]
