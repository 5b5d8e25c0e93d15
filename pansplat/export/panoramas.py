"""The panoramas of a tour as 2:1 photographs with titles, links, notes and start views: out of tiles and cube faces."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pansplat.images.image_files import read_height, read_mask, read_panorama, write_image
from pansplat.inputs.pairs import Panorama
from pansplat.inputs.photographs import LINKS, describe_notes
from pansplat.predictor import Progress


def write_panoramas(folder: Path, panoramas: Sequence[Panorama], progress: Progress | None = None) -> int:
    """Write NAME.jpg for each panorama in its full resolution, NAME_mask.png for a mask, and links.json.

    What blur masks hide is hidden in the files. Poses are not written.

    Args:
        folder: exists.
        panoramas: of unique names.
        progress: called with a description and the completed fraction.

    Returns:
        The bytes of all files.
    """
    for number, view in enumerate(panoramas):
        if progress is not None:
            progress(f"writing {view.name}.jpg", number / len(panoramas))
        height = read_height(view.image)
        write_image(folder / f"{view.name}.jpg", read_panorama(view.image, height)[0], panorama="photograph")
        if view.mask is not None:
            mask = np.repeat(read_mask(view.mask, height).numpy()[..., None], 3, axis=2)
            write_image(folder / f"{view.name}_mask.png", mask.astype(np.uint8) * 255, panorama=False)
    entries = {f"{view.name}.jpg": _describe(view) for view in panoramas}
    entries = {name: entry for name, entry in entries.items() if entry}
    if entries:
        (folder / LINKS).write_text(json.dumps(entries, indent=1, ensure_ascii=False), "utf-8")
    return sum(file.stat().st_size for file in folder.iterdir())


def _describe(view: Panorama) -> dict[str, object]:
    """The entry of links.json."""
    links = [
        {"to": f"{link.target}.jpg", "yaw": link.yaw, "pitch": link.pitch} | ({"text": link.text} if link.text else {})
        for link in view.links
    ]
    notes = describe_notes(view.notes)
    entry: dict[str, object] = {"title": view.title, "start": view.start, "links": links, "notes": notes}
    return {key: value for key, value in entry.items() if value}
