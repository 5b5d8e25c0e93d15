"""Pose files of estimated poses, and the automatic estimate for a folder of panoramas without poses."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pansplat.errors import InputError, InputWarning
from pansplat.images.cube_images import CUBE_SUFFIX
from pansplat.images.image_files import is_assembled, read_thumbnail
from pansplat.inputs.content import hash_pixels
from pansplat.inputs.folders import make_names_unique
from pansplat.inputs.panorama_sets import Collection, Panorama, PanoramaSet, localize_sets, single_view_sets
from pansplat.inputs.placements import Placement, read_approximate
from pansplat.inputs.poses import rigid_matrix, to_cam2world
from pansplat.inputs.views import CAMERA_HEIGHT
from pansplat.poses.edit import POSES, find_kept, merge_estimate, name_pictures, read_pose_content, write_pose_file
from pansplat.poses.estimate import NoPosesError, PoseEstimate, estimate_poses, fingerprint_estimates
from pansplat.poses.pose_file import CONVENTION, make_pose_content, matrix_of, world_of
from pansplat.system.descriptions import list_first
from pansplat.system.files import require_replaceable
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import Store, hash_parts

_KIND = "poses"  # what the store calls estimated poses


def require_mergeable(path: Path, images: Sequence[Path], *, overwrite: bool) -> None:
    """Check, before the estimate, the file that `write_poses` is to write; it need not exist."""
    names = set(name_pictures(path, images).values())
    if path.exists() and not (names and names <= find_kept(read_pose_content(path), path, names)):
        return
    require_replaceable("--out", [path], overwrite)


def write_poses(estimate: PoseEstimate, path: Path, *, overwrite: bool = False) -> None:
    """Write the poses as a poses.json.

    Names in a poses.json are relative to its folder; each group is a world. If the file exists, the poses are merged
    into it (`pansplat.poses.edit.merge_estimate`), and it stays as NAME.bak.
    """
    names = name_pictures(path, estimate.images)
    content, kept = make_pose_content(estimate, names), []
    if path.exists():
        content, kept = merge_estimate(path, estimate, names, overwrite=overwrite)
    if kept:
        warnings.warn(
            f"{path} keeps its poses of {list_first(kept)}: pansplat did not write all poses of their world; "
            "`--overwrite` replaces them.",
            InputWarning,
            stacklevel=2,
        )
    write_pose_file(path, content)


def estimate_panoramas(
    folder: Path,
    panoramas: Sequence[Panorama],
    *,
    camera_height: float = CAMERA_HEIGHT,
    baseline: tuple[Path | str, Path | str, float] | None = None,
) -> PoseEstimate:
    """Poses of panoramas, by all that their folder or tour states of them; every command estimates poses by this.

    Args:
        folder: whose cache keeps features and relative poses.
        panoramas: two or more; masks and links count, and titles are used in messages. A link to a name that several
            have is not used.
        camera_height, baseline: see `estimate_poses`.

    Raises:
        NoPosesError: no two panoramas could be placed.
    """
    counts = Counter(panorama.name for panorama in panoramas)
    images = {panorama.name: panorama.image for panorama in panoramas if counts[panorama.name] == 1}
    return estimate_poses(
        [panorama.image for panorama in panoramas],
        masks={panorama.image: panorama.mask for panorama in panoramas},
        links={
            panorama.image: {images[link.target]: link.yaw for link in panorama.links if link.target in images}
            for panorama in panoramas
        },
        names=_name_for_people(panoramas),
        camera_height=camera_height,
        baseline=baseline,
        cache_folder=folder,
    )


def _name_for_people(panoramas: Sequence[Panorama]) -> dict[Path, str]:
    """The title of each panorama that no other one has, or else the name of its file or scene."""
    counts = Counter(panorama.title for panorama in panoramas)
    return {
        panorama.image: panorama.title
        if panorama.title and counts[panorama.title] == 1
        else panorama.image.name.removesuffix(CUBE_SUFFIX)
        for panorama in panoramas
    }


def estimate_sets(
    folder: Path,
    panoramas: Sequence[Panorama],
    *,
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
    on_unposed: Callable[[list[PanoramaSet]], None] | None = None,
) -> list[PanoramaSet]:
    """The pairs of panoramas without poses; the outcome of the estimate is cached like predictions.

    Panoramas that are placed together have one world. Each other one has a world of its own, a pair of a single view,
    after them. Warnings state the figures of the check, and name the panoramas without a pose and those that cannot be
    read.

    Args:
        folder: the folder of the tour.
        panoramas: two or more, of unique names.
        near, far: metres; they override the estimated range.
        camera_height: height of the cameras over the floor, metres.
        on_unposed: called before poses are estimated, if none are cached, with a pair of a single view for each
            panorama.
    """
    store, key = Store(folder), _hash_inputs(panoramas, camera_height)
    content = store.read(_KIND, key)
    if content is None:
        if on_unposed is not None:
            single = single_view_sets(panoramas, folder, near, far, siblings=panoramas)
            on_unposed(localize_sets(make_names_unique(single), camera_height))
        content = _estimate(folder, panoramas, camera_height)
        store.write(_KIND, key, content)
    source = next(iter(store.find(_KIND, key)), None)  # None if no folder at all can be written
    pairs = _make_pairs(folder, panoramas, content, source, near, far)
    return localize_sets(make_names_unique(pairs), camera_height)


def _estimate(folder: Path, panoramas: Sequence[Panorama], camera_height: float) -> dict[str, Any]:
    """What is cached: the content of a poses.json by names, also if no panorama is placed; and unreadable ones."""
    names = {panorama.image: panorama.name for panorama in panoramas}
    try:
        estimate = estimate_panoramas(folder, panoramas, camera_height=camera_height)
    except NoPosesError as error:
        estimate = PoseEstimate(tuple(names), (), error.reasons, {}, approximate=error.approximate)
    unreadable = [image for image in estimate.unplaced if not _is_readable(image)]
    if len(unreadable) == len(panoramas):
        raise NoPosesError(estimate.unplaced)
    content = make_pose_content(estimate, names)
    content["estimate"]["unplaced"] = {names[image]: reason for image, reason in estimate.unplaced.items()}
    return content | {"unreadable": [names[image] for image in unreadable]}


def _is_readable(image: Path) -> bool:
    try:
        read_thumbnail(image, 16)
    except InputError:
        return False
    return True


def _make_pairs(
    folder: Path,
    panoramas: Sequence[Panorama],
    content: Mapping[str, Any],
    source: Path | None,
    near: float | None,
    far: float | None,
) -> list[PanoramaSet]:
    """The pairs of an estimate, with its warnings."""
    by_name = {panorama.name: panorama for panorama in panoramas}
    worlds, stated, unreadable = content["worlds"], content["estimate"], content["unreadable"]
    if worlds:
        advice = ""
        with contextlib.suppress(InputError):
            name_pictures(folder / POSES, [panorama.image for panorama in panoramas])
            advice = f" `pansplat pose {folder} -o {folder / POSES}` writes them to a file."
        warnings.warn(f"{folder} has no poses; they were estimated: {stated['summary']}.{advice}", stacklevel=4)
    for name, reason in stated["unplaced"].items():
        outcome = "cannot be read and is left out" if name in unreadable else "has no pose and is a scene of its own"
        warnings.warn(f"{_describe(by_name[name], folder)} {outcome}: {reason}", InputWarning, stacklevel=4)
    posed: list[list[Panorama]] = [[] for _ in worlds]
    for name, entry in content["poses"].items():
        pose, world = to_cam2world(rigid_matrix(matrix_of(entry), str(source)), CONVENTION), world_of(entry)
        placement = Placement(source=source)
        posed[world].append(replace(by_name[name], cam2world=pose, world=world, placement=placement))
    pairs = []
    for views, world in zip(posed, worlds, strict=True):
        only = folder.resolve().name if len(views) == 2 else None
        found = Collection(source or folder, folder, tuple(views), near=world["near"], far=world["far"], name=only)
        pairs += found.sets(near, far)
    units = {view.name: world["unit"] for views, world in zip(posed, worlds, strict=True) for view in views}
    about = read_approximate(stated, {name: view.image for name, view in by_name.items()}, units)
    readable = [panorama for panorama in panoramas if panorama.name not in unreadable]
    reasons = stated["unplaced"]
    single = [
        replace(view, placement=Placement("not placed", reasons[view.name], source, about=about.get(view.image)))
        for view in readable
        if view.name in reasons
    ]
    return pairs + single_view_sets(single, folder, near, far, siblings=readable, first_world=len(worlds))


def _describe(panorama: Panorama, folder: Path) -> str:
    """The file with the title, or the folder of the tour with the label of a panorama that has no file of its own."""
    if is_assembled(panorama.image):
        return f"{folder}: {panorama.label}"
    return f"{panorama.image}{f' ({panorama.title})' if panorama.title else ''}"


def _hash_inputs(panoramas: Sequence[Panorama], camera_height: float) -> str:
    """A hash of the code, of the names, by which the entry states its poses, of their links and of the pictures."""
    stated = [(view.name, [(link.target, round(link.yaw, 6)) for link in view.links]) for view in panoramas]
    pixels = hash_pixels(panoramas, tuple(view.image for view in panoramas))
    code = hash_sources(__name__), fingerprint_estimates()
    return hash_parts(*code, f"{camera_height:g}", json.dumps(stated), pixels)
