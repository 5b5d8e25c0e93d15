"""Changes of a folder's poses.json: poses that a user places by hand, and those of a new estimate.

The first change of a folder whose poses were estimated writes all estimated poses to a poses.json; from then on the
file counts. Other entries and fields of the file stay as they are. Each change is written at once and can be undone.
"""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from numpy import ndarray as Array

from pansplat.errors import InputError, InputWarning
from pansplat.images.blur_masks import locate_panorama
from pansplat.images.cube_images import CUBE_SUFFIX
from pansplat.images.image_files import is_assembled
from pansplat.inputs.folder_formats import MATRIX_KEYS
from pansplat.inputs.panorama_sets import Panorama
from pansplat.inputs.placements import BY_HAND, list_stated_places, read_unit
from pansplat.inputs.poses import from_cam2world, parse_convention, rigid_matrix, to_cam2world
from pansplat.inputs.stated_files import locate_inside
from pansplat.inputs.web_tours import is_scene_of_tour
from pansplat.poses.estimate import PoseEstimate, PoseGroup
from pansplat.poses.pose_file import (
    format_pose_file,
    make_pose_content,
    make_range,
    mark_worlds,
    matrix_of,
    rename_panoramas,
    world_of,
)
from pansplat.system.atomic import replacing
from pansplat.system.descriptions import list_first
from pansplat.system.files import read_file
from pansplat.system.store import read_entry
from pansplat.system.strict_json import MAX_BYTES, convert, read_field, read_json

POSES = "poses.json"

Content = dict[str, Any]


class PoseEditor:
    """The poses of a folder's panoramas, which it changes.

    Attributes:
        file: the poses.json.
    """

    def __init__(self, folder: Path, panoramas: Sequence[Panorama]) -> None:
        """Nothing is written before the first change.

        Args:
            folder: the folder of the tour.
            panoramas: all of it, as they were loaded.
        """
        self.file = folder / POSES
        self._sources = {panorama.placement.source for panorama in panoramas} - {None}
        self._names = name_pictures(self.file, [panorama.image for panorama in panoramas])
        self._images = {panorama.name: panorama.image for panorama in panoramas}
        if not self._sources:
            raise InputError(f"{folder}: needed estimated poses or a {POSES} to change poses, got another format.")
        self._undo: list[tuple[bytes | None, bytes]] = []
        if self.file in self._sources:
            self._check_convention(panoramas)

    def _check_convention(self, panoramas: Sequence[Panorama]) -> None:
        """Refuse poses that were read otherwise than the file states them; what is written would be wrong."""
        content = self.read()
        for panorama in panoramas:
            name = self._names[panorama.image]
            if name in content["poses"] and not np.allclose(
                _read_pose(content, name, self.file), panorama.cam2world.numpy(), atol=1e-6
            ):
                raise InputError(
                    f"{self.file}: needed poses in the convention of the file to change them, got those of "
                    "--convention, or the file has changed; correct its convention, and load it again."
                )

    @property
    def can_undo(self) -> bool:
        """Whether a change of this editor is left to undo."""
        return bool(self._undo)

    def read(self) -> Content:
        """The content of the poses.json, or what it would be for estimated poses."""
        if self.file.exists():
            return read_pose_content(self.file)
        (source,) = self._sources
        files = {name: image.name for name, image in self._images.items()}
        names = {name: self._names[image] for name, image in self._images.items()}
        return rename_panoramas(read_entry(source), names, files)

    def read_unit(self, world: int) -> float | None:
        """Metres that are one camera height of the estimated depths in a world, if the file states it."""
        return read_unit(self.read(), world)

    def place(self, poses: Mapping[Path, Float[Array, "4 4"]], world: int | None, unit: float | None = None) -> None:
        """Place panoramas by hand.

        Args:
            poses: cam2world of each, metres.
            world: number of the world whose panoramas they are placed beside; None for one of their own.
            unit: metres that are a camera height, of a new world.
        """
        content = self.read()
        if world is None:
            world = _find_free_world(content)
            if unit is not None:
                _list_worlds(content, world)[world]["unit"] = round(unit, 4)
        for image, pose in poses.items():
            _put(content, self._names[image], pose, world, self.file, {"placed": BY_HAND})
        self._write(content)

    def undo(self) -> None:
        """Undo the last change: the file is as before, or removed if the change made it."""
        if not self._undo:
            raise InputError(f"{self.file}: needed a change to undo, got none.")
        before, after = self._undo[-1]
        if _read(self.file) != after:
            raise InputError(f"{self.file}: needed the file as it was written, got another content; it is kept.")
        if before is not None:
            _replace(self.file, before)
        else:
            try:
                self.file.unlink()
            except OSError as error:
                raise InputError(f"cannot remove {self.file}: got '{error.strerror}'; remove it by hand.") from error
        self._undo.pop()

    def _write(self, content: Content) -> None:
        self._undo.append(write_pose_file(self.file, content, backup=not self._undo))


def read_pose_content(file: Path) -> Content:
    """The content of a poses.json; an InputError if it cannot be read, or a pose or world is invalid."""
    content = read_json(file, Content)
    _convention_of(content, file)
    read_field(content, "worlds", list[Content], file)
    for name, entry in convert(content.get("poses"), Content, f"{file}, poses").items():
        _read_pose(content, name, file)
        if isinstance(entry, dict):
            read_field(entry, "world", Annotated[int, Meta(ge=0)], f"{file}, {name!r}")
    return content


def find_kept(content: Content, file: Path, read: Collection[str], replaced: Collection[str] = ()) -> set[str]:
    """The names in a poses.json whose poses an estimate leaves as they are.

    An estimate replaces poses that are `replaced` in any case, and worlds that an estimate wrote, that nobody has
    changed since, and whose panoramas it has all read, as far as they are there: poses are relative to their world.
    """
    poses, free, folder = content["poses"], _find_own_worlds(content), file.resolve().parent
    free -= {world_of(poses[name]) for name in set(poses) - set(read) if (folder / name).exists()}
    return {name for name in set(poses) - set(replaced) if world_of(poses[name]) not in free}


def merge_estimate(
    file: Path, estimate: PoseEstimate, names: Mapping[Path, str], *, overwrite: bool = False
) -> tuple[Content, list[str]]:
    """The content of a poses.json with the poses of an estimate, and the names that it would place but leaves.

    Poses that stay (`find_kept`) and other fields are as before. A panorama is placed where the estimate has it,
    relative to the nearest panorama of its group that stays; a group without such gets a world of its own.

    Args:
        file: the poses.json.
        estimate: the new poses.
        names: the name of each of its files in the poses.json.
        overwrite: whether all poses are replaced that the estimate has.
    """
    content = read_pose_content(file)
    poses, own = content["poses"], _find_own_worlds(content)
    placed = {names[image] for group in estimate.groups for image in group.poses}
    kept = find_kept(content, file, names.values(), placed if overwrite else ())
    former = {name: poses.pop(name) for name in list(poses) if name not in kept}
    for group in estimate.groups:
        new = {image: names[image] for image in group.poses if names[image] not in kept}
        anchors = {image: names[image] for image in group.poses if names[image] in kept}
        world = None if anchors else _find_free_world(content, [former[n] for n in new.values() if n in former])
        if new and world is not None:
            worlds, made = _list_worlds(content, world), make_range(group)
            worlds[world] = worlds[world] | made if world in own else made | worlds[world] | {"unit": made["unit"]}
            own.add(world)
        scales = _find_scales(content, file, group, anchors) if new else {}
        for image, name in new.items():
            pose = group.poses[image]
            if anchors:
                nearest = min(anchors, key=lambda a: float(np.linalg.norm(group.poses[a][:3, 3] - pose[:3, 3])))
                world = world_of(poses[anchors[nearest]])
                motion = np.linalg.inv(group.poses[nearest]) @ pose
                motion[:3, 3] *= scales[world]
                pose = _read_pose(content, anchors[nearest], file) @ motion
            assert world is not None
            poses[name] = former.pop(name, {})
            _put(content, name, pose, world, file, {})
    for name, entry in former.items():  # the estimate has no pose of it
        if set(_as_object(entry, content, file)) - {*MATRIX_KEYS, "world"}:
            poses[name] = entry | {"world": _find_free_world(content)}
    fresh, old = make_pose_content(estimate, names)["estimate"], _read_estimate(content)
    read, files = set(names.values()), {image.name for image in names}
    unplaced = old["unplaced"].items() if isinstance(old.get("unplaced"), dict) else ()
    content["estimate"] = {
        **old,
        **fresh,
        "approximate": [entry for entry, stated in list_stated_places(old) if not set(stated.between) <= read]
        + fresh["approximate"],
        "unplaced": {name: reason for name, reason in unplaced if name not in files} | fresh["unplaced"],
        "written": " ".join(mark for world, mark in mark_worlds(content).items() if world in own),
    }
    return content, [name for name in poses if name in kept & placed]


def _find_scales(content: Content, file: Path, group: PoseGroup, anchors: Mapping[Path, str]) -> dict[int, float]:
    """The scale of the worlds of panoramas that stay, relative to that of an estimated group.

    It is that of the units, or else the median ratio of the distances between these panoramas; 1, with a warning, for a
    single one.
    """
    scales = {}
    for world in {world_of(content["poses"][name]) for name in anchors.values()}:
        own = {image: name for image, name in anchors.items() if world_of(content["poses"][name]) == world}
        ratios = []
        for pair in itertools.combinations(own, 2):
            first, second = (_read_pose(content, own[image], file)[:3, 3] for image in pair)
            distance = np.linalg.norm(group.poses[pair[0]][:3, 3] - group.poses[pair[1]][:3, 3])
            if distance > 0:
                ratios.append(float(np.linalg.norm(first - second) / distance))
        unit, median = read_unit(content, world), float(np.median(ratios)) if ratios else 0.0
        if unit is None and not median:
            warnings.warn(
                f"{file} has only one measured pose, of {list_first(list(own.values()))}, beside new ones, which does "
                "not state a scale: the distances of the new ones are those of the estimate in metres; set "
                "--baseline or --camera-height in the unit of the file, or measure a second pose.",
                InputWarning,
                stacklevel=4,
            )
        scales[world] = unit / group.unit if unit is not None else median or 1.0
    return scales


def name_pictures(path: Path, images: Sequence[Path]) -> dict[Path, str]:
    """The names of images in a poses.json, relative to its folder; an InputError for one outside of it.

    Scenes of a web tour in this folder that are made from cube faces have their own names.
    """
    names = {}
    for image in images:
        if is_scene_of_tour(path.parent, image):
            names[image] = image.name.removesuffix(CUBE_SUFFIX)
        elif is_scene_of_tour(locate_panorama(image).parent, image):
            raise InputError(f"{path}: needed the folder of the web tour, where its poses stand, got another one.")
        elif is_assembled(image):
            raise InputError(
                f"{path}: needed 2:1 photographs or a web tour, got the cube faces of "
                f"{image.name.removesuffix(CUBE_SUFFIX)}, of which it holds no poses; `pansplat export --photos` makes "
                "photographs of them."
            )
        else:
            file = locate_inside(path.parent, os.path.abspath(image), path)
            names[image] = file.relative_to(path.parent).as_posix()
    return names


def _find_free_world(content: Content, former: Sequence[Any] = ()) -> int:
    """The first world without panoramas, those of former entries first."""
    used = set(map(world_of, content["poses"].values()))
    return next(world for world in (*map(world_of, former), *range(len(used) + 1)) if world not in used)


def _list_worlds(content: Content, world: int) -> list[Content]:
    """What the file states of the worlds, at least up to one; changes of the list are changes of the file."""
    worlds = content["worlds"] = content.get("worlds") or []
    worlds += [{} for _ in range(world + 1 - len(worlds))]
    return worlds


def _read_estimate(content: Content) -> Content:
    estimate = content.get("estimate")
    return estimate if isinstance(estimate, dict) else {}


def _find_own_worlds(content: Content) -> set[int]:
    """The worlds whose poses are as an estimate wrote them."""
    marks = str(_read_estimate(content).get("written")).split()
    return {world for world, mark in mark_worlds(content).items() if mark in marks}


def _convention_of(content: Content, file: Path) -> str:
    return parse_convention(content.get("convention"), file)


def _as_object(entry: Any, content: Content, file: Path) -> Content:
    """An entry with room for fields."""
    return dict(entry) if isinstance(entry, dict) else {_convention_of(content, file).split()[0]: entry}


def _read_pose(content: Content, name: str, file: Path) -> Float[Array, "4 4"]:
    entry = content["poses"][name]
    return to_cam2world(rigid_matrix(matrix_of(entry), f"{file}, {name!r}"), _convention_of(content, file)).numpy()


def _put(
    content: Content, name: str, pose: Float[Array, "4 4"], world: int, file: Path, fields: Mapping[str, str]
) -> None:
    """Set the pose of an entry in the convention of the file; other fields of the entry are kept."""
    convention = _convention_of(content, file)
    entry = _as_object(content["poses"].get(name, {}), content, file)
    key = next((key for key in MATRIX_KEYS if key in entry), convention.split()[0])
    matrix = from_cam2world(torch.from_numpy(np.asarray(pose, np.float64)), convention)
    entry.pop("placed", None)
    entry |= {key: np.round(matrix.numpy(), 9).tolist(), **fields}
    if world or "world" in entry:
        entry["world"] = world
    content["poses"][name] = entry[key] if set(entry) == {convention.split()[0]} else entry


def _read(file: Path) -> bytes | None:
    return read_file(file, limit=MAX_BYTES) if file.exists() else None


def write_pose_file(file: Path, content: Content, *, backup: bool = True) -> tuple[bytes | None, bytes]:
    """Write a poses.json, of which another content may stay as NAME.bak, NAME.bak1 and so on; returns both contents."""
    before, after = _read(file), format_pose_file(content).encode()
    if backup and before not in (None, after):
        backups = (file.with_name(f"{file.name}.bak{number or ''}") for number in itertools.count())
        _replace(next(path for path in backups if _read(path) in (None, before)), before)
    _replace(file, after)
    return before, after


def _replace(file: Path, data: bytes) -> None:
    with replacing(file) as temporary:
        temporary.write_bytes(data)
