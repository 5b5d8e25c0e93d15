"""Posed panoramas on disk, and their grouping into pairs of context and target views."""

from __future__ import annotations

import heapq
import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.geometry.world import USER_FRAME, WorldFrame, choose_frame, require_depth_range
from pansplat.images.blur_masks import MASK_SUFFIX, find_mask_beside, list_mask_files, locate_panorama, split_mask_name
from pansplat.images.image_files import (
    READABLE_SUFFIXES,
    is_assembled,
    read_depth,
    read_height,
    read_mask,
    read_panorama,
)
from pansplat.images.masks import find_holes, scene_mask_of_files
from pansplat.inputs.placements import PLACED, Placement
from pansplat.inputs.views import Views
from pansplat.system.descriptions import describe_range, list_first
from pansplat.system.files import require_text
from pansplat.system.options import CAMERA_HEIGHT

NEAR, FAR = 0.45, 10.0  # metres; depth range of the official indoor data (docs/official.md, section 2.1)
FAR_SEQUENCE = 50.0  # metres; for halls (docs/official.md, section 2.2)

MAX_CONTEXT = 64  # context panoramas of a pair

MAX_NAMES = 20  # names that a note lists
_MATCHING_SECONDS = 2.0  # time to match two panoramas of 512 rows on two cores


@dataclass(frozen=True)
class Link:
    """A way from one panorama towards another, as a tour states it: often on the door, 10 to 25 degrees off.

    Attributes:
        target: name of the other panorama.
        yaw: to the right of the centre column, radians.
        pitch: below the horizon, radians.
        text: label of the hot spot; may be empty.
    """

    target: str
    yaw: float
    pitch: float = 0.0
    text: str = ""


@dataclass(frozen=True)
class Note:
    """Information at a direction in a panorama, as a tour states it.

    Attributes:
        yaw, pitch: its direction, as that of a link, radians.
        text: plain text of one or more lines.
        addresses: web pages, http or https.
    """

    yaw: float
    pitch: float
    text: str
    addresses: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Panorama:
    """One panorama file with its pose.

    Attributes:
        name: the stem of the file name, or the view's folder where all files have the same name.
        image: picture of a format of `READABLE_SUFFIXES`, or a file that stands for cube faces or perspective pictures
            (pansplat.images.cube_images, .rig_images).
        cam2world: float64, OpenCV axes, metres.
        mask: image that is white where the panorama shows the scene; None to detect static content.
        depth: radial depth, 16-bit PNG in millimetres or EXR in metres; None when there is none.
        is_scan: whether the panorama is rendered from a scan, whose holes are exactly black.
        world: number of the coordinate frame of the pose; one without a known pose has a world of its own.
        title: for people, if it differs from the name.
        links: to other panoramas of the tour.
        notes: information in it.
        tour: title of the tour; empty if it has none.
        start: yaw and pitch, as of a link, of the view that a visitor sees first; None if there is none.
        camera_height: over the floor, metres; the scale of a scene of this panorama alone.
        placement: how the pose was found, or why there is none.
        frame: where the world of the pose is in the user's world, that of files.
        links_at: the links.json that links and notes are read from, the keys there, of which the first that it has
            counts, and the notes where it states none; None if none is read.
    """

    name: str
    image: Path
    cam2world: Float[Tensor, "4 4"]
    mask: Path | None = None
    depth: Path | None = None
    is_scan: bool = False
    world: int = 0
    title: str = ""
    links: tuple[Link, ...] = ()
    notes: tuple[Note, ...] = ()
    tour: str = ""
    start: tuple[float, float] | None = None
    camera_height: float = CAMERA_HEIGHT
    placement: Placement = PLACED
    frame: WorldFrame = USER_FRAME
    links_at: tuple[Path, tuple[str, ...], tuple[Note, ...]] | None = None

    def __repr__(self) -> str:
        position = ", ".join(f"{x:.3g}" for x in self.cam2world[:3, 3].tolist())
        place = self.placement.state if self.placement.state == "not placed" else f"at ({position}) m"
        return f"<Panorama {self.label}: {self.image}, {place}>"

    @property
    def label(self) -> str:
        """The title, or the name if there is none."""
        return self.title or self.name

    @property
    def file_label(self) -> str:
        """The name of the file, or the label of a panorama that is made from cube faces or perspective pictures."""
        return self.label if is_assembled(self.image) else self.image.name

    def in_frame(self, frame: WorldFrame) -> Panorama:
        """The panorama in the world of another frame."""
        return replace(self, cam2world=frame.localize(self.frame.globalize(self.cam2world)), frame=frame)


@dataclass(frozen=True, eq=False)
class PanoramaSet:
    """Context and target panoramas of one scene; a scene of a single view has one context panorama.

    Image files are read by `load_context` and `load_targets`.

    Attributes:
        name: unique among the pairs that were loaded together; valid as a file name.
        folder: folder of the files.
        context: the input of a predictor; one panorama in a scene of a single view.
        targets: panoramas for comparison; may be empty.
        near, far: radial depth range to search, metres.
        siblings: all panoramas taken with the same camera; static content is detected in them.
    """

    name: str
    folder: Path
    context: tuple[Panorama, ...]
    targets: tuple[Panorama, ...]
    near: float
    far: float
    siblings: tuple[Path, ...] = ()

    def __repr__(self) -> str:
        parts = [f"context {list_first([panorama.name for panorama in self.context])}"]
        if self.targets:
            parts.append(f"target{'s' if len(self.targets) > 1 else ''} {list_first([p.name for p in self.targets])}")
        parts.append(f"near and far {describe_range(self.near, self.far, 'm')}")
        return f"<PanoramaSet {self.name}: {', '.join(parts)}, in {self.folder}>"

    @property
    def panoramas(self) -> tuple[Panorama, ...]:
        """Those of its scene, in order, as `TourGraph` names them: the context."""
        return self.context

    @property
    def image_height(self) -> int:
        """Height of the smallest context panorama, pixels."""
        return min(read_height(panorama.image) for panorama in self.context)

    def load_context(self, height: int) -> Views:
        """The context panoramas at (height, 2 height)."""
        if len(self.context) > MAX_CONTEXT:
            raise too_many_panoramas(self.name, len(self.context))
        return self._load(self.context, height)

    def load_targets(self, height: int) -> Views:
        """The target panoramas at (height, 2 height); `Views` of length 0 when the pair has no targets."""
        return self._load(self.targets, height)

    def _load(self, panoramas: tuple[Panorama, ...], height: int) -> Views:
        images = torch.empty(len(panoramas), 3, height, 2 * height)
        masks, holes = torch.empty(2, len(panoramas), height, 2 * height, dtype=torch.bool)
        for i, panorama in enumerate(panoramas):
            images[i], opaque = read_panorama(panorama.image, height)
            holes[i] = find_holes(images[i], is_scan=panorama.is_scan)
            masks[i] = opaque & read_scene_mask(panorama, self.siblings, height)
            if not masks[i].any():
                raise InputError(
                    f"{panorama.mask or panorama.image}: needed some pixels that show the scene (white in a mask, "
                    "opaque in an image), got none; invert the mask or remove the alpha channel."
                )
        frame = panoramas[0].frame if panoramas else USER_FRAME
        depths = [read_depth(p.depth, height) / frame.unit for p in panoramas if p.depth is not None]
        no_poses = torch.empty(0, 4, 4, dtype=torch.float64)
        return Views(
            images=images,
            cam2world=torch.stack([p.cam2world for p in panoramas]) if panoramas else no_poses,
            masks=masks,
            near=self.near,
            far=self.far,
            names=tuple(p.name for p in panoramas),
            camera_height=panoramas[0].camera_height if panoramas else CAMERA_HEIGHT,
            depths=torch.stack(depths) if depths and len(depths) == len(panoramas) else None,
            frame=frame,
            holes=holes if holes.any() else None,
        )


def read_scene_mask(panorama: Panorama, siblings: tuple[Path, ...], height: int) -> Bool[Tensor, "height width"]:
    """The mask file of a panorama if there is one, else the complement of the static content of its siblings."""
    if panorama.mask is not None:
        return read_mask(panorama.mask, height)
    return scene_mask_of_files(siblings, height)


def too_many_panoramas(source: object, count: int) -> InputError:
    """The error for more context panoramas than are matched, with the work that they would take."""
    hours = count * (count - 1) * _MATCHING_SECONDS / 3600
    return InputError(
        f"{source}: needed at most {MAX_CONTEXT} context panoramas, got {count}: each is matched with all others, "
        f"{count * (count - 1):,} times, which takes about {hours:,.1f} hours; choose fewer, or make several pairs."
    )


ViewGroup = tuple[tuple[int, ...], tuple[int, ...]]
"""Indices of the context views, and of the target views."""


@dataclass(frozen=True, eq=False)
class Collection:
    """The panoramas that a format reads in a folder, before they are grouped into pairs.

    Attributes:
        source: file or folder that error messages name.
        folder: the folder of the files.
        panoramas: in file order; none if no poses are known.
        groups: given context and target views; None to pair neighbours.
        ordered: whether the panoramas are in order along a path, so that consecutive ones are neighbours.
        near, far: metres.
        ranges: near and far of worlds (`Panorama.world`) that have others.
        name: name of the only pair; None to join the names of the context views.
        unposed: panoramas without a pose beside the others; each is a scene of its own.
        folders: those of which all panoramas are in the collection.
    """

    source: Path
    folder: Path
    panoramas: tuple[Panorama, ...] = ()
    groups: tuple[ViewGroup, ...] | None = None
    ordered: bool = False
    near: float = NEAR
    far: float = FAR
    ranges: dict[int, tuple[float, float]] = field(default_factory=dict)
    name: str | None = None
    unposed: tuple[Panorama, ...] = ()
    folders: tuple[Path, ...] = ()

    @property
    def views(self) -> tuple[Panorama, ...]:
        """All panoramas."""
        return (*self.panoramas, *self.unposed)

    @property
    def needs_poses(self) -> bool:
        """Whether there are panoramas for an estimate of poses, and no poses."""
        return not self.panoramas and len(self.unposed) > 1

    def sets(self, near: float | None = None, far: float | None = None) -> list[PanoramaSet]:
        """One pair per group, those with targets first, then one of a single view for each other panorama.

        Warns about posed panoramas that are in no group.

        Args:
            near, far: metres; they override the collection's values.

        Raises:
            InputError: it needs poses.
        """
        folder = self.folder
        if self.needs_poses:
            names = list_first([panorama.file_label for panorama in self.unposed])
            raise InputError(
                f"{folder}: needed poses for the panoramas, got images only ({names}); run `pansplat pose {folder} -o "
                f"{folder / 'poses.json'}`, or add a pose file (docs/input.md)."
            )
        siblings = tuple(panorama.image for panorama in self.panoramas)
        pairs, groups = [], self._select_groups()
        for indices in groups:
            context, targets = (tuple(self.panoramas[i] for i in part) for part in indices)
            name = self.name or "-".join(view.name for view in context)
            pairs.append(
                PanoramaSet(name, folder, context, targets, *self._range(context[0].world, near, far), siblings)
            )
        used = {i for group in groups for part in group for i in part}
        alone = [panorama for i, panorama in enumerate(self.panoramas) if i not in used]
        if alone:
            warnings.warn(
                f"{self.source}: in no pair of pairs.json, and each a scene of its own: "
                f"{list_first([view.file_label for view in alone], MAX_NAMES)}.",
                category=InputWarning,
                stacklevel=4,
            )
        pairs += [
            PanoramaSet(view.name, folder, (view,), (), *self._range(view.world, near, far), siblings) for view in alone
        ]
        first_world = 1 + max((panorama.world for panorama in self.panoramas), default=-1)
        every = tuple(heapq.merge(self.panoramas, self.unposed, key=lambda panorama: panorama.name))
        single = single_view_sets(self.unposed, folder, near, far, siblings=every, first_world=first_world)
        return [replace(pair, name=self.name or pair.name) for pair in single] if not pairs else pairs + single

    def _range(self, world: int, near: float | None, far: float | None) -> tuple[float, float]:
        """Near and far of a world, unless they are given."""
        own = self.ranges.get(world, (self.near, self.far))
        near, far = own[0] if near is None else near, own[1] if far is None else far
        require_depth_range(near, far, self.source, 'set "near" and "far" in poses.json or on the command line')
        return near, far

    def _select_groups(self) -> list[ViewGroup]:
        """The given groups without repeated contexts, those with targets first; else pairs of neighbours."""
        if self.groups is None or len(self.panoramas) == 1:
            worlds: dict[int, list[int]] = {}
            for number, panorama in enumerate(self.panoramas):
                worlds.setdefault(panorama.world, []).append(number)
            return [(pair, ()) for members in worlds.values() for pair in self._neighbours(members)]
        with_targets = [group for group in self.groups if group[1]]
        seen = {frozenset(context) for context, _ in with_targets}
        without_targets = []
        for group in self.groups:
            key = frozenset(group[0])
            if not group[1] and key not in seen:
                seen.add(key)
                without_targets.append(group)
        return with_targets + without_targets

    def _neighbours(self, members: Sequence[int]) -> list[tuple[int, ...]]:
        """Consecutive panoramas of a path, or the edges of the minimum spanning tree of the camera centres.

        The tree contains every panorama, pairs each with a near one, and has no pair twice.

        Args:
            members: the panoramas of one world; a single one is returned alone.
        """
        count = len(members)
        if count == 1:
            return [(members[0],)]
        if self.ordered or count == 2:
            return list(itertools.pairwise(members))
        centres = torch.stack([self.panoramas[number].cam2world[:3, 3] for number in members])
        distances = (centres[:, None] - centres).norm(dim=-1).round(decimals=6)
        # Of equal distances, as in a grid, the first ones are taken on every processor. A weight of 0 is no edge.
        weights = distances.unique(return_inverse=True)[1] * count**2 + torch.arange(1, count**2 + 1).view(count, count)
        tree = scipy.sparse.csgraph.minimum_spanning_tree(weights.triu(1).double().numpy())
        return sorted(tuple(sorted((members[a], members[b]))) for a, b in zip(*tree.nonzero(), strict=True))


def localize_sets(pairs: Sequence[PanoramaSet], camera_height: float = CAMERA_HEIGHT) -> list[PanoramaSet]:
    """The pairs of one camera height in working worlds (`WorldFrame`), one for all panoramas of a world of a folder."""
    worlds: dict[tuple[Path, int], list[tuple[Tensor, float]]] = {}
    for pair in pairs:
        for view in pair.context + pair.targets:
            worlds.setdefault((pair.folder, view.world), []).append((view.cam2world, pair.near))
    frames = {
        key: choose_frame(torch.stack([pose for pose, _ in found]), min(near for _, near in found))
        for key, found in worlds.items()
    }
    localized = []
    for pair in pairs:
        context, targets = (
            tuple(replace(view.in_frame(frames[pair.folder, view.world]), camera_height=camera_height) for view in part)
            for part in (pair.context, pair.targets)
        )
        near, far = (bound / context[0].frame.unit for bound in (pair.near, pair.far))
        localized.append(replace(pair, context=context, targets=targets, near=near, far=far))
    return localized


def single_view_sets(
    panoramas: Sequence[Panorama],
    folder: Path,
    near: float | None,
    far: float | None,
    *,
    siblings: Sequence[Panorama] | None = None,
    first_world: int = 0,
) -> list[PanoramaSet]:
    """A pair of one view for each panorama.

    Args:
        folder: the tour's; predictions are cached there.
        near, far: metres; None for the range of rooms.
        siblings: panoramas of the same camera, by default the same ones.
        first_world: the world of the first panorama; each has a world of its own.
    """
    near, far = NEAR if near is None else near, FAR if far is None else far
    require_depth_range(near, far, folder, 'set "near" and "far" on the command line')
    images = tuple(panorama.image for panorama in (panoramas if siblings is None else siblings))
    return [
        PanoramaSet(view.name, folder, (replace(view, world=world),), (), near, far, images)
        for world, view in enumerate(panoramas, start=first_world)
    ]


def list_names(files: Sequence[Path]) -> str:
    """The names of files, for notes; of many the first ones."""
    return list_first([file.name for file in files], MAX_NAMES)


def find_mask(image: Path, folder: Path) -> Path | None:
    """The mask file of an image: STEM_mask.png or mask.png in the image's folder, or mask.png in `folder`."""
    panorama = locate_panorama(image)
    places = dict.fromkeys((panorama.parent, folder))
    of_folders = (mask for place in places for mask in list_mask_files(place, MASK_SUFFIX).get("", []))
    return find_mask_beside(panorama, MASK_SUFFIX) or next(of_folders, None)


def is_panorama_name(name: str) -> bool:
    """Whether the name of a file is that of a panorama, and not of a mask, of depth, or of a hidden file."""
    path = Path(name)
    is_picture = path.suffix.lower() in READABLE_SUFFIXES and not name.startswith(".")
    return is_picture and not f"_{path.stem}".lower().endswith("_depth") and split_mask_name(path) is None


def list_panorama_files(folder: Path) -> list[Path]:
    """Panorama files of a folder, sorted by name; without masks and depth files.

    Raises:
        InputError: a name is not UTF-8.
    """
    files = [path for path in sorted(folder.iterdir()) if is_panorama_name(path.name) and path.is_file()]
    for file in files:
        require_text(file)
    return files
