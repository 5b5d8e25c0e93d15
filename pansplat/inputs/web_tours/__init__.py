"""Tours that people already have: exports of the Marzipano Tool, and tours of Pannellum.

Only files inside the tour's folder are read. Nothing is fetched from the web, and no script is run.
"""

from __future__ import annotations

from pathlib import Path

from pansplat.errors import InputError
from pansplat.images.blur_masks import locate_panorama
from pansplat.images.cube_images import CUBE_SUFFIX
from pansplat.inputs.panorama_sets import Collection
from pansplat.inputs.web_tours.entries import make_panoramas
from pansplat.inputs.web_tours.marzipano import find_marzipano, read_marzipano
from pansplat.inputs.web_tours.pannellum import SUFFIXES, find_pannellum, read_pannellum


def find_web_tours(folder: Path) -> list[Path]:
    """The file that describes the tour in a folder, if there is one. It may be faulty.

    Raises:
        OSError: the folder cannot be listed.
    """
    source = find_marzipano(folder) or find_pannellum(folder)
    return [] if source is None else [source]


def is_web_tour_file(file: Path) -> bool:
    """Whether a file may describe a tour, by its suffix."""
    return file.suffix.lower() in SUFFIXES


def is_scene_of_tour(folder: Path, image: Path) -> bool:
    """Whether a panorama is a scene of the web tour in a folder that is made from cube faces."""
    tours = find_web_tours(folder) if image.name.endswith(CUBE_SUFFIX) else []
    return any(source.parent.resolve() == locate_panorama(image).parent for source in tours)


def read_web_tour(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The panoramas of a tour, with titles, links, notes and start views, and without poses. No pixels are read.

    Warns about panoramas, links and levels that cannot be used.

    Args:
        source: data.js of an export of the Marzipano Tool, its index.html, or the configuration of Pannellum in JSON,
            HTML or JavaScript.
    """
    del convention
    marzipano = find_marzipano(source.parent)
    if marzipano is not None and (marzipano == source or source.suffix.lower() in (".html", ".htm")):
        source, (title, entries) = marzipano, read_marzipano(marzipano)
    else:
        title, entries = read_pannellum(source)
    if not entries:
        raise InputError(f"{source}: needed panoramas, got none that can be used; the notes name the reasons.")
    name, panoramas = folder.resolve().name, tuple(make_panoramas(entries, source, title))
    return Collection(source, folder, name=name, unposed=panoramas)
