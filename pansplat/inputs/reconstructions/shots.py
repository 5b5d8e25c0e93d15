"""The pictures of a reconstruction with their poses, and the panoramas that they are or that they are joined to."""

from __future__ import annotations

import difflib
import glob
import itertools
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.geometry.world import WorldFrame
from pansplat.images.blur_masks import MASK_SUFFIX, find_mask_beside, fold_name
from pansplat.images.image_files import READABLE_SUFFIXES
from pansplat.images.rig_images import Lens, RigImage, RigView, write_rig
from pansplat.inputs.panorama_sets import FAR, NEAR, Collection, Panorama, find_mask, list_names
from pansplat.inputs.poses import read_number, rigid_matrix, to_cam2world
from pansplat.inputs.stated_files import find_inside
from pansplat.system.components import label_components
from pansplat.system.descriptions import describe_count
from pansplat.system.files import make_unique_name

Vector = tuple[float, float, float]

_SCALE_FILE = "scale.txt"
_IMAGE_FOLDERS = ("images", "image", "panos", "frames", "input", ".")
_RIG_SIZE = 1e-3  # distance of cameras of one rig, over the median distance of cameras from their mean
_LOCAL_ROUNDING, _FAR_ROUNDING = 1e-5, 1e-9  # rounding: over distances from the mean; from the origin
_MIN_DOWN_COSINE = 0.999  # least cosine of the angle between the down axes of two pictures that agree
_MIN_SHOWN_SHARE = 0.6  # share of the sphere that a panorama's pictures show, at least; four side faces show two thirds
_MIN_POINTS = 100  # points without which near and far are not measured
_NEAR_QUANTILE, _FAR_QUANTILE, _RANGE_FACTOR = 0.01, 0.99, 2.0  # quantiles of distances of points; a factor
_BASELINES = (0.2, 20.0)  # without points: near and far, relative to the median distance of a camera to the next one


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture with its pose.

    Attributes:
        name: as the file states it.
        image: the picture.
        cam2world: OpenCV axes, the unit of the file.
        lens: None for an equirectangular picture.
        mask: picture that is white where this one shows the scene; None if there is none.
    """

    name: str
    image: Path
    cam2world: Float[Tensor, "4 4"]
    lens: Lens | None = None
    mask: Path | None = None


@dataclass(eq=False)
class Reconstruction:
    """What a file states.

    Attributes:
        source: the file that messages name.
        folder: that of the pictures; joined panoramas are described in its cache folder.
        convention: that of the poses.
        to_world: from the world of the file to that of the shots, rigid, after `scale`.
        scale: units of the world per unit of the file.
        shots: those whose pictures exist, in the order of the file.
        points: points of the scene, in the unit of the file; may be empty.
        is_metric: whether the unit of the file is the metre; otherwise nothing is known of it.
        missing: names of pictures that were not found.
    """

    source: Path
    folder: Path
    convention: str
    to_world: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    scale: float = 1.0
    shots: list[Shot] = field(default_factory=list)
    points: Float[Array, "point 3"] = field(default_factory=lambda: np.empty((0, 3)))
    is_metric: bool = False
    missing: list[str] = field(default_factory=list)

    def add(
        self, name: str, image: Path | None, matrix: Any, lens: Lens | None = None, mask: Path | None = None
    ) -> None:
        """Add a picture with its pose, 3x4 or 4x4 numbers in the convention; or note that it is missing."""
        if image is None:
            self.missing.append(name)
            return
        values = matrix.tolist() if isinstance(matrix, (Array, Tensor)) else matrix
        pose = to_cam2world(rigid_matrix(values, f"{self.source}, {name!r}"), self.convention).clone()
        pose[:3, 3] *= self.scale
        self.shots.append(Shot(name, image, self.to_world @ pose, lens, mask))


def note_smaller(source: Path, count: int) -> None:
    """Warn that a file holds smaller reconstructions, if there are any."""
    if count:
        warnings.warn(
            f"{source}: {describe_count(count, 'smaller reconstruction')} without relation to the largest: left out.",
            InputWarning,
            stacklevel=5,
        )


def find_picture(folder: Path, name: str, *more: Path) -> Path | None:
    """A picture that a file names: below a folder, in its usual subfolders or others; a name may lack its suffix.

    Of a name that leads out of the folder only the last part is used.
    """
    name = name.replace("\\", "/")
    last = name.rsplit("/", 1)[-1]
    bases = [*more, *(folder / sub for sub in _IMAGE_FOLDERS)]
    for found in (find_inside(base, part) for part in (name, last) for base in bases):
        if found is not None:
            return found
    for base in bases:  # the label has no suffix
        found = sorted(base.glob(f"{glob.escape(last)}.*")) if last and base.is_dir() else []
        pictures = [file for file in found if file.suffix.lower() in READABLE_SUFFIXES and file.is_file()]
        if pictures:
            return pictures[0]
    return None


def make_collection(found: Reconstruction) -> Collection:
    """The panoramas of a reconstruction: equirectangular pictures, and those that perspective ones are joined to.

    Positions are multiplied by the number in scale.txt, metres per unit of the file, if there is one. Near and far
    follow from the points, or else from the distances of the cameras if the unit is unknown. Warns about pictures that
    are missing, that show too little, and about an unknown unit.
    """
    if found.missing and not found.shots:
        raise InputError(
            f"{found.source}: needed its pictures, got none of them ({', '.join(found.missing[:3])}, ...); copy them "
            f"to {found.folder / 'images'}."
        )
    if found.missing:
        warnings.warn(
            f"left out of {found.source}, because the pictures are missing in {found.folder}, out of which no path is "
            f"followed: {list_names([Path(name) for name in found.missing])}.",
            InputWarning,
            stacklevel=4,
        )
    panoramas, partial = _join_shots(replace(found, shots=_add_masks(found)))
    if not panoramas:
        raise InputError(
            f"{found.source}: needed 360-degree panoramas, got {describe_count(len(partial), 'perspective picture')}, "
            f"with at most {100 * max(partial.values(), default=0):.0f}% of what is around a camera in view; give "
            f"equirectangular pictures or all cube faces with their poses, or move {found.source.name} away to "
            "estimate poses."
        )
    if partial:
        warnings.warn(
            f"left out of {found.source}, because they show a part of what is around a camera only: "
            f"{list_names([Path(name) for name in partial])}.",
            InputWarning,
            stacklevel=4,
        )
    places = dict.fromkeys((found.source.parent, found.folder))
    scale_file = next((place / _SCALE_FILE for place in places if (place / _SCALE_FILE).is_file()), None)
    scale = 1.0 if scale_file is None else read_number(scale_file)
    if scale_file is None and not found.is_metric:
        warnings.warn(
            f"{found.source}: the unit of its poses is arbitrary and is taken as a metre; write metres per unit into "
            f"{found.folder / _SCALE_FILE}.",
            InputWarning,
            stacklevel=4,
        )
    panoramas = [replace(view, cam2world=WorldFrame(1 / scale).localize(view.cam2world)) for view in panoramas]
    centres = np.stack([view.cam2world[:3, 3].numpy() for view in panoramas])
    near, far = _find_range(centres, found.points * scale, found.is_metric or scale_file is not None)
    return Collection(
        found.source,
        found.folder,
        tuple(panoramas),
        near=near,
        far=far,
        name=found.folder.resolve().name if len(panoramas) == 2 else None,
        folders=tuple(dict.fromkeys((found.folder, *(shot.image.parent for shot in found.shots)))),
    )


def _find_range(
    centres: Float[Array, "camera 3"], points: Float[Array, "point 3"], is_metric: bool
) -> tuple[float, float]:
    """Near and far of cameras, from the distances of points to their nearest cameras, or of cameras to each other."""
    tree = scipy.spatial.cKDTree(centres)
    if len(points) >= _MIN_POINTS:
        distances = tree.query(points)[0]
        near = float(np.quantile(distances, _NEAR_QUANTILE)) / _RANGE_FACTOR
        far = float(np.quantile(distances, _FAR_QUANTILE)) * _RANGE_FACTOR
        if 0 < 2 * near < far:
            return float(f"{near:.3g}"), float(f"{far:.3g}")
    if is_metric or len(centres) < 2:
        return NEAR, FAR
    baseline = float(np.median(tree.query(centres, k=2)[0][:, 1]))
    return (_BASELINES[0] * baseline, _BASELINES[1] * baseline) if baseline > 0 else (NEAR, FAR)


def _add_masks(found: Reconstruction) -> list[Shot]:
    """The pictures with their masks: in masks/, of their names with or without the suffix, or beside them."""
    folder = found.folder / "masks"
    files = [file for file in folder.rglob("*") if file.suffix.lower() in READABLE_SUFFIXES and file.is_file()]
    names = {file: file.relative_to(folder).with_suffix("").as_posix() for file in files}
    masks = {fold_name(name): file for file, name in names.items()}
    shots: list[Shot] = []
    for shot in found.shots:
        parts = fold_name(shot.name.replace("\\", "/")).split("/")
        ends = ["/".join(parts[start:]) for start in range(len(parts))]
        keys = (*ends, *(end.rsplit(".", 1)[0] for end in ends))
        found_masks = (masks[key] for key in keys if key in masks)
        mask = shot.mask or next(found_masks, None) or find_mask_beside(shot.image, MASK_SUFFIX)
        shots.append(replace(shot, mask=mask))
    used = {shot.mask.resolve() for shot in shots if shot.mask is not None}
    unmasked, folders = {s.image for s in shots if s.mask is None}, {s.image.parent for s in shots}
    for mask in (file for file in files if file.resolve() not in used):
        if find_picture(found.folder, names[mask], *folders) in (None, *unmasked):
            close = difflib.get_close_matches(names[mask], [shot.name for shot in shots], n=1)
            raise InputError(
                f"{mask}: needed the name of a picture before {mask.suffix}, got {names[mask]!r}"
                f"{''.join(f' (did you mean {name}?)' for name in close)}; rename or remove the mask."
            )
    return shots


def _join_shots(found: Reconstruction) -> tuple[list[Panorama], dict[str, float]]:
    """The panoramas, and the pictures that are no part of one, with the share of the sphere around their cameras."""
    panoramas: list[Panorama] = []
    partial: dict[str, float] = {}
    taken: set[str] = set()
    for shots in _group_by_place(found.shots):
        names = [shot.name for shot in shots]
        if shots[0].lens is None:
            image, pose = shots[0].image, shots[0].cam2world
            name = make_unique_name(image.stem, taken)
        else:
            rig, pose = _make_rig(shots)
            coverage = rig.measure_coverage()
            if coverage < _MIN_SHOWN_SHARE:
                partial |= dict.fromkeys(names, coverage)
                continue
            name = make_unique_name(_find_common_name(names), taken)
            image = write_rig(rig, found.folder, name)
        taken.add(name)
        stated = shots[0].mask if shots[0].lens is None else None
        panoramas.append(Panorama(name, image, pose, stated or find_mask(image, found.folder)))
    return panoramas, partial


def _group_by_place(shots: Sequence[Shot]) -> Iterable[list[Shot]]:
    """Each equirectangular picture alone, and the perspective pictures of each place."""
    centres = np.stack([shot.cam2world[:3, 3].numpy() for shot in shots])
    offsets = centres - centres.mean(axis=0)
    spread = float(np.median(np.linalg.norm(offsets, axis=1)))
    local, farthest = (float(np.abs(places).max()) for places in (offsets, centres))
    tolerance = _RIG_SIZE * spread + _LOCAL_ROUNDING * (1 + local) + _FAR_ROUNDING * farthest
    flat = np.flatnonzero([shot.lens is not None for shot in shots])
    ends = flat[scipy.spatial.cKDTree(centres[flat]).query_pairs(tolerance, output_type="ndarray")]
    groups: dict[int, list[Shot]] = {}
    for shot, label in zip(shots, label_components(len(shots), ends.tolist()), strict=True):
        groups.setdefault(label, []).append(shot)
    return groups.values()


def _make_rig(shots: Sequence[Shot]) -> tuple[RigImage, Float[Tensor, "4 4"]]:
    """The panorama of perspective pictures, and its pose.

    Down is that of three or more pictures that agree, or else the mean of all, and forward the direction of the first
    picture that is not vertical.
    """
    poses = torch.stack([shot.cam2world for shot in shots])
    agree = poses[:, :3, 1] @ poses[:, :3, 1].T > _MIN_DOWN_COSINE
    most = int(agree.sum(dim=1).argmax())
    down = (poses[agree[most]] if int(agree[most].sum()) > 2 else poses)[:, :3, 1].mean(dim=0)
    down = poses[0, :3, 1] if float(down.norm()) < 0.1 else down / down.norm()
    flat = poses[:, :3, 2] - (poses[:, :3, 2] @ down)[:, None] * down
    first = int((flat.norm(dim=1) > 0.5).int().argmax())
    forward = flat[first] / flat[first].norm() if float(flat[first].norm()) > 0.5 else poses[0, :3, 2]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack((torch.linalg.cross(down, forward), down, forward), dim=1)
    pose[:3, 3] = poses[:, :3, 3].mean(dim=0)
    views = []
    for shot in shots:
        assert shot.lens is not None
        rotation = (pose[:3, :3].T @ shot.cam2world[:3, :3]).tolist()
        views.append(RigView(shot.image, tuple(map(tuple, rotation)), shot.lens, shot.mask))
    return RigImage(tuple(views)), pose


def _find_common_name(names: Sequence[str]) -> str:
    """A name for the panorama of pictures: what their names, or those of their folder, have in common."""
    paths = [Path(name.replace("\\", "/")) for name in names]
    letters = itertools.takewhile(lambda at: len(set(at)) == 1, zip(*(path.stem for path in paths), strict=False))
    common = "".join(at[0] for at in letters).rstrip("_-. ")
    parents = {path.parent.name for path in paths}
    if not common and len(parents) == 1:
        common = parents.pop()
    return re.sub(r"[^\w.-]+", "_", common or paths[0].stem).strip(".") or "panorama"
