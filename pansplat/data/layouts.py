"""Folder layouts of posed panoramas: `load_pairs` recognises and reads them (docs/input.md)."""

from __future__ import annotations

import dataclasses
import difflib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.data.pairs import FAR, FAR_SEQUENCE, NEAR, Case, Collection, Pair, Panorama, mask_beside, pictures_in
from pansplat.data.poses import (
    number_field,
    parse_convention,
    read_json,
    read_number,
    read_trajectory,
    rigid_matrix,
    to_cam2world,
)
from pansplat.errors import InputError

_DEPTH = 4  # folders in folders that are looked into


def load_pairs(
    path: Path | str, *, convention: str | None = None, near: float | None = None, far: float | None = None
) -> list[Pair]:
    """The pairs at a path, those with targets first. Pictures are read later, when a pair is asked for them.

    Args:
        path: a pair folder, a folder of many posed panoramas, or a folder of such folders; docs/input.md has
            the
            formats (poses.json, PanoGRF, 360Loc, KITTI, TUM, game-map triplets). Also one of their .json
            files.
        convention: pose convention, such as "world2cam opengl", to use instead of what the files say.
        near, far: radial depth range in metres, instead of what the files say.

    Raises:
        InputError: nothing usable there, or the first thing that is wrong in what is there.
    """
    root = Path(path).expanduser()
    if not root.exists():
        raise InputError(f"{root}: needed a folder of posed panoramas, got no such path; check it.")
    triplet = root if root.is_file() and root in triplet_files(root.parent) else None
    if root.is_file():
        if root.suffix.lower() not in (".json", ".kitti", ".tum", ".txt"):
            raise InputError(f"{root}: needed a folder of posed panoramas, got a file; give the folder that holds it.")
        root = root.parent
    try:
        collections = [(root, read_triplet(triplet, convention))] if triplet else _collections(root, convention, _DEPTH)
    except OSError as error:
        raise InputError(
            f"{error.filename or root}: needed a readable folder, got '{error.strerror}'; check its rights."
        ) from error
    if not collections:
        raise _nothing_found(root)
    pairs = [pair for folder, collection in collections for pair in collection.pairs(folder, near, far)]
    return _with_unique_names(sorted(pairs, key=lambda pair: not pair.targets))


def _collections(folder: Path, convention: str | None, depth: int) -> list[tuple[Path, Collection]]:
    """The collections of a folder itself, or else those of the folders in it."""
    if is_pose_file_folder(folder):
        return [(folder, read_pose_file_folder(folder, convention))]
    if is_loc360_sequence(folder):
        return [(folder, read_loc360_sequence(folder, convention))]
    if is_matterport3d_scene(folder):
        return [(folder, read_matterport3d_scene(folder, convention))]
    if triplets := triplet_files(folder):
        return [(folder, read_triplet(path, convention)) for path in triplets]
    if trajectory_file(folder) is not None:
        return [(folder, read_trajectory_folder(folder, convention))]
    if depth == 0:
        return []
    inner = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and not sub.name.startswith((".", "__"))]
    return [found for sub in inner for found in _collections(sub, convention, depth - 1)]


def _nothing_found(root: Path) -> InputError:
    images = pictures_in(root)
    if images:
        names = ", ".join(path.name for path in images[:3]) + (" ..." if len(images) > 3 else "")
        return InputError(
            f"{root}: needed poses for the panoramas, got pictures only ({names}); add a poses.json "
            "or another pose file, see docs/input.md."
        )
    return InputError(
        f"{root}: needed two or more panoramas with poses (poses.json, camera_pose.json, rot.txt and "
        "tran.txt, *.kitti or *.tum), got none of these files there or in its folders; see docs/input.md."
    )


def _with_unique_names(pairs: list[Pair]) -> list[Pair]:
    """The same pairs; where two have one name the folder's name goes before it, then a number after it."""
    counts = Counter(pair.name for pair in pairs)
    names = [p.name if counts[p.name] == 1 else f"{p.folder.resolve().name}_{p.name}" for p in pairs]
    counts, seen = Counter(names), Counter()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if counts[name] == 1 else f"{name}_{seen[name]}"
    return [dataclasses.replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]


POSES, PAIRS = "poses.json", "pairs.json"
_MATRIX_KEYS = ("cam2world", "world2cam", "pose")


def is_pose_file_folder(folder: Path) -> bool:
    """Whether the folder has a poses.json."""
    return (folder / POSES).is_file()


def read_pose_file_folder(folder: Path, convention: str | None = None) -> Collection:
    """The panoramas that poses.json names, and the cases of pairs.json.

    Args:
        folder: where both files are; picture names in them are relative to it.
        convention: goes before the one in the file.

    Raises:
        InputError: what is missing or wrong, with the file and the entry.
    """
    source = folder / POSES
    content = read_json(source)
    entries = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise InputError(
            f'{source}: needed {{"convention": ..., "poses": {{picture: pose, ...}}}}, got no object '
            '"poses"; '
            "see docs/input.md."
        )
    if convention is None:
        convention = parse_convention(content.get("convention"), source)
        stated = True
    else:
        convention, stated = parse_convention(convention, "`convention`"), False
    panoramas = tuple(_read_pose_entry(folder, name, entry, convention, stated) for name, entry in entries.items())
    if len(panoramas) < 2:
        named = {panorama.image.name for panorama in panoramas}
        others = [path.name for path in pictures_in(folder) if path.name not in named]
        without = f"; pictures without a pose: {', '.join(others[:5])}" if others else ""
        raise InputError(
            f"{source}: needed poses of two or more panoramas, got {len(panoramas)}{without}; add what is missing."
        )
    near, far = number_field(content, "near", source), number_field(content, "far", source)
    cases = _cases(folder / PAIRS, list(entries)) if (folder / PAIRS).is_file() else None
    return Collection(
        source,
        panoramas,
        cases,
        near=NEAR if near is None else near,
        far=FAR if far is None else far,
        name=folder.resolve().name if (len(cases) if cases is not None else len(panoramas) - 1) == 1 else None,
    )


def _read_pose_entry(folder: Path, name: str, entry: Any, convention: str, stated: bool) -> Panorama:
    source = f"{folder / POSES}, {name!r}"
    image = folder / name
    if not image.is_file():
        raise InputError(f"{source}: needed the picture {image}, got no such file; correct the name or add the file.")
    matrix, mask, depth = entry, None, None
    if isinstance(entry, dict):
        key = next((key for key in _MATRIX_KEYS if key in entry), None)
        if key is None:
            raise InputError(f'{source}: needed a pose, got only {sorted(entry)}; add its 4x4 matrix as "cam2world".')
        if stated and key in ("cam2world", "world2cam") and not convention.startswith(key):
            raise InputError(
                f'{source}: needed one convention, got the key "{key}" under the convention "{convention}"; '
                "make both say the same."
            )
        matrix = entry[key]
        mask, depth = (_named_file(folder, entry, key, source) for key in ("mask", "depth"))
    cam2world = to_cam2world(rigid_matrix(matrix, source), convention)
    return Panorama(image.stem, image, cam2world, mask or mask_beside(image, folder), depth)


def _named_file(folder: Path, entry: dict[str, Any], key: str, source: str) -> Path | None:
    """A file that an entry names."""
    if entry.get(key) is None:
        return None
    path = folder / str(entry[key])
    if not path.is_file():
        raise InputError(f'{source}: needed the {key} file {path}, got no such file; correct or remove "{key}".')
    return path


def _cases(source: Path, names: list[str]) -> tuple[Case, ...]:
    """Cases of pairs.json: its triplets, then its pairs, as indices into `names`."""
    content = read_json(source)
    if not isinstance(content, dict) or not any(key in content for key in ("pairs", "triplets")):
        raise InputError(
            f'{source}: needed {{"pairs": [{{"context": [a, b], "target": [m]}}]}}, got neither "pairs" nor '
            '"triplets"; see docs/input.md.'
        )
    cases = []
    for key in ("triplets", "pairs"):
        entries = content.get(key) or []
        if not isinstance(entries, list):
            raise InputError(f'{source}: needed a list as "{key}", got {str(entries)[:60]}; put [ ] around it.')
        for number, entry in enumerate(entries, start=1):
            where = f"{source}, {key} {number}"
            context, target = (entry.get("context"), entry.get("target")) if isinstance(entry, dict) else (None, None)
            context = _names(context)
            if context is None or len(set(context)) < max(2, len(context)):
                raise InputError(
                    f'{where}: needed two or more different pictures as "context", a list of names, '
                    f"got {str(entry)[:60]}; correct it."
                )
            targets = _names([target] if isinstance(target, str) else target or [])
            if targets is None:
                raise InputError(f'{where}: needed a picture or a list of them as "target", got {target}; correct it.')
            case = tuple(tuple(_index(name, names, where) for name in group) for group in (context, targets))
            cases.append((case[0], case[1]))
    if not cases:
        raise InputError(f"{source}: needed at least one pair, got none; add one or remove the file.")
    return tuple(cases)


def _names(value: Any) -> list[str] | None:
    """A list of strings as it is; None for anything else."""
    return value if isinstance(value, list) and all(isinstance(name, str) for name in value) else None


def _index(name: str, names: list[str], where: str) -> int:
    if name in names:
        return names.index(name)
    close = difflib.get_close_matches(name, names, n=1)
    meant = f" (did you mean {close[0]!r}?)" if close else ""
    raise InputError(f"{where}: needed pictures that {POSES} has a pose for, got {name!r}{meant}; add its pose.")


_HABITAT = "cam2world opengl"
_Z_UP = torch.tensor(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)), dtype=torch.float64)


def is_matterport3d_scene(folder: Path) -> bool:
    """Whether the folder's folders are views with rot.txt or tran.txt."""
    return bool(_view_folders(folder))


def read_matterport3d_scene(folder: Path, convention: str | None = None) -> Collection:
    """The views of one scene folder, in sorted order; `convention` goes before Habitat's.

    Raises:
        InputError: a file of a view is missing or wrong, or there is one view only.
    """
    convention = _HABITAT if convention is None else parse_convention(convention, "`convention`")
    panoramas = tuple(_read_view_folder(view, folder, convention) for view in _view_folders(folder))
    last = len(panoramas) - 1
    cases = (((0, last), tuple(range(1, last))),) if last > 0 else None
    return Collection(folder, panoramas, cases, near=NEAR, far=FAR, name=folder.resolve().name)


def _view_folders(folder: Path) -> list[Path]:
    names = ("rot.txt", "tran.txt")
    return [v for v in sorted(folder.iterdir()) if v.is_dir() and any((v / name).is_file() for name in names)]


def _read_view_folder(view: Path, folder: Path, convention: str) -> Panorama:
    image = view / "rgb.png"
    if not image.is_file():
        raise InputError(f"{view}: needed rgb.png beside rot.txt and tran.txt, got none; add it.")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = _numbers(view / "rot.txt", 9).reshape(3, 3)
    matrix[:3, 3] = _numbers(view / "tran.txt", 3)
    cam2world = _Z_UP @ to_cam2world(rigid_matrix(matrix.tolist(), str(view / "rot.txt")), convention)
    depth = view / "depth.png"
    return Panorama(view.name, image, cam2world, mask_beside(image, folder), depth if depth.is_file() else None)


def _numbers(path: Path, count: int) -> Float[Tensor, count]:
    """That many numbers from a text file."""
    if not path.is_file():
        raise InputError(f"{path}: needed the view's pose there, got no such file; add it.")
    try:
        values = np.array(path.read_text().split(), dtype=np.float64)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: needed {count} numbers, got other text ({error}); correct it.") from error
    if values.size != count:
        raise InputError(f"{path}: needed {count} numbers, got {values.size}; correct it.")
    return torch.from_numpy(values)


LOC360 = "camera_pose.json"
_PICTURE_FOLDERS = ("image", "images", "panos", "frames", ".")


def is_loc360_sequence(folder: Path) -> bool:
    """Whether the folder has a camera_pose.json."""
    return (folder / LOC360).is_file()


def read_loc360_sequence(folder: Path, convention: str | None = None) -> Collection:
    """The frames of a 360Loc sequence, in the order of camera_pose.json (frame: 4x4); pictures are in image/.

    The matrices are cam2world with OpenCV axes, as the original system reads them, unless `convention` says
    otherwise. Source: OFFICIAL.md 2.2.

    Raises:
        InputError: a frame without a picture, or a pose that is none.
    """
    source = folder / LOC360
    convention = "cam2world opencv" if convention is None else parse_convention(convention, "`convention`")
    content = read_json(source)
    if not isinstance(content, dict):
        raise InputError(
            f"{source}: needed {{frame: 4x4 matrix, ...}}, got {type(content).__name__}; see docs/input.md."
        )
    panoramas = []
    for frame, matrix in content.items():
        image = next((folder / sub / frame for sub in _PICTURE_FOLDERS if (folder / sub / frame).is_file()), None)
        if image is None:
            raise InputError(f"{source}: needed the picture {folder / 'image' / frame}, got no such file; add it.")
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, {frame!r}"), convention)
        panoramas.append(Panorama(image.stem, image, cam2world, mask_beside(image, folder)))
    return Collection(source, tuple(panoramas), ordered=True, far=FAR_SEQUENCE)


def trajectory_file(folder: Path) -> Path | None:
    """The trajectory of a folder: *.kitti, *.tum, poses.txt or *trajectory*.txt.

    Raises:
        InputError: there are several.
    """
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.is_file()
        and (
            path.suffix.lower() in (".kitti", ".tum")
            or (path.suffix.lower() == ".txt" and ("trajectory" in path.stem.lower() or path.stem.lower() == "poses"))
        )
    ]
    if len(found) > 1:
        raise InputError(
            f"{folder}: needed one trajectory, got {', '.join(path.name for path in found)}; keep the right one."
        )
    return found[0] if found else None


def read_trajectory_folder(folder: Path, convention: str | None = None) -> Collection:
    """Pictures by name with the lines of the folder's trajectory: picture i has line i.

    A scale.txt with one number multiplies all translations (the original system's way to metres).

    Raises:
        InputError: no pictures, another number of poses than of pictures, a wrong file.
    """
    source = trajectory_file(folder)
    if source is None:
        raise InputError(f"{folder}: needed a trajectory (*.kitti, *.tum, poses.txt), got none; add it.")
    expected = source.suffix.lower().lstrip(".")
    if expected == "txt":
        expected = next((kind for kind in ("kitti", "tum") if kind in source.stem.lower()), None)
    trajectory = read_trajectory(source, convention, expected)
    images: list[Path] = []
    for sub in _PICTURE_FOLDERS:
        images = images or (pictures_in(folder / sub) if (folder / sub).is_dir() else [])
    if len(images) != len(trajectory.poses):
        raise InputError(
            f"{source}: needed one pose a picture ({len(images)} pictures), got {len(trajectory.poses)} "
            f"{trajectory.kind.upper()} poses; keep only the pictures that were tracked, in order, or "
            "use poses.json."
        )
    scale = read_number(folder / "scale.txt") if (folder / "scale.txt").is_file() else 1.0
    panoramas = tuple(
        Panorama(image.stem, image, _scaled(pose, scale), mask_beside(image, folder))
        for image, pose in zip(images, trajectory.poses, strict=True)
    )
    return Collection(source, panoramas, ordered=True, far=FAR_SEQUENCE)


def _scaled(pose: Float[Tensor, "4 4"], scale: float) -> Float[Tensor, "4 4"]:
    scaled = pose.clone()
    scaled[:3, 3] = pose[:3, 3] * scale
    return scaled


def triplet_files(folder: Path) -> list[Path]:
    """The NAME.json files of a folder that have a NAME_0.png beside them."""
    return [path for path in sorted(folder.glob("*.json")) if path.with_name(f"{path.stem}_0.png").is_file()]


def read_triplet(source: Path, convention: str | None = None) -> Collection:
    """The triplet of one NAME.json; `convention` goes before cam2world opencv.

    Raises:
        InputError: poses or pictures are missing or wrong.
    """
    convention = "cam2world opencv" if convention is None else parse_convention(convention, "`convention`")
    content = read_json(source)
    matrices = content.get("c2w") if isinstance(content, dict) else None
    if not isinstance(matrices, list) or len(matrices) < 2:
        raise InputError(f'{source}: needed a list of two or more 4x4 matrices as "c2w", got none; see docs/input.md.')
    panoramas = []
    for i, matrix in enumerate(matrices):
        image = source.with_name(f"{source.stem}_{i}.png")
        if not image.is_file():
            raise InputError(f"{source}: needed the picture {image.name} for pose {i}, got no such file; add it.")
        depth = source.with_name(f"{source.stem}_{i}_depth.png")
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, pose {i}"), convention)
        mask = mask_beside(image, source.parent)
        panoramas.append(Panorama(image.stem, image, cam2world, mask, depth if depth.is_file() else None))
    last = len(panoramas) - 1
    return Collection(source, tuple(panoramas), (((0, last), tuple(range(1, last))),), name=source.stem)
