"""The panoramas of one folder and which of them belong together, before they become pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from pansplat.data.images import READABLE_SUFFIXES
from pansplat.data.pair import Pair, Panorama
from pansplat.errors import InputError

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
