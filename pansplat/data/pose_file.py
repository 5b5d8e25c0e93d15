"""Our own folder format: pictures, poses.json and optionally pairs.json (docs/input.md)."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

from pansplat.data.collection import FAR, NEAR, Case, Collection, mask_beside, pictures_in
from pansplat.data.pair import Panorama
from pansplat.data.poses import number_field, parse_convention, read_json, rigid_matrix, to_cam2world
from pansplat.errors import InputError

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
    panoramas = tuple(_panorama(folder, name, entry, convention, stated) for name, entry in entries.items())
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


def _panorama(folder: Path, name: str, entry: Any, convention: str, stated: bool) -> Panorama:
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
