"""The panoramas of a tour as 2:1 photographs with titles, links, notes and start views: out of tiles and cube faces."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pansplat.images.blur_masks import fill_hidden
from pansplat.images.image_files import read_height, read_mask, read_panorama, write_image
from pansplat.inputs.panorama_sets import Panorama, is_panorama_name
from pansplat.inputs.photographs import LINKS, describe_notes
from pansplat.system.files import make_unique_name
from pansplat.system.progress import report_progress, stage


@stage()
def write_panoramas(folder: Path, panoramas: Sequence[Panorama]) -> int:
    """Write NAME.jpg for each panorama in its full resolution, NAME_mask.png for a mask or alpha, and links.json.

    If a name is taken, the next panorama of that name gets the name of its folder before its own, and a number if that
    is taken, too. What blur masks and alpha hide is hidden in the files. Poses are not written.

    Args:
        folder: exists.
        panoramas: of any folders.

    Returns:
        The bytes of all files.
    """
    names = _name_files(panoramas)
    for number, (view, name) in enumerate(zip(panoramas, names, strict=True)):
        report_progress(f"writing {name}.jpg", number / len(panoramas))
        height = read_height(view.image)
        image, shown = read_panorama(view.image, height)
        write_image(folder / f"{name}.jpg", fill_hidden(image, shown), panorama="photograph")
        if view.mask is not None:
            shown &= read_mask(view.mask, height)
        if not shown.all():
            mask = shown.numpy()[..., None].repeat(3, axis=2)
            write_image(folder / f"{name}_mask.png", mask.astype(np.uint8) * 255, panorama=False)
    named = {(view.image.parent, view.name): name for view, name in zip(panoramas, names, strict=True)}
    entries = {f"{name}.jpg": _describe(view, named) for view, name in zip(panoramas, names, strict=True)}
    entries = {name: entry for name, entry in entries.items() if entry}
    if entries:
        (folder / LINKS).write_text(json.dumps(entries, indent=1, ensure_ascii=False), "utf-8")
    return sum(file.stat().st_size for file in folder.iterdir())


def _name_files(panoramas: Sequence[Panorama]) -> list[str]:
    """Distinct names for the files of panoramas, of which none is that of a mask, depth or hidden file."""
    names: list[str] = []
    for view in panoramas:
        name = view.name if is_panorama_name(f"{view.name}.jpg") else f"{view.name.replace('.', '_').lstrip('_')}_photo"
        if name.lower() in map(str.lower, names):
            name = f"{view.image.parent.resolve().name}_{name}"
        names.append(make_unique_name(name, names))
    return names


def _describe(view: Panorama, named: Mapping[tuple[Path, str], str]) -> dict[str, object]:
    """The entry of links.json; `named` are the files of panoramas by folder and name."""
    links = [
        {"to": f"{named.get((view.image.parent, link.target), link.target)}.jpg", "yaw": link.yaw, "pitch": link.pitch}
        | ({"text": link.text} if link.text else {})
        for link in view.links
    ]
    notes = describe_notes(view.notes)
    entry: dict[str, object] = {"title": view.title, "start": view.start, "links": links, "notes": notes}
    return {key: value for key, value in entry.items() if value}
