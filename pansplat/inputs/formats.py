"""The formats of panoramas on disk, a row each (docs/input.md): how files are found in a folder, and read.

The argument `convention` of the readers, one of `CONVENTIONS`, overrides that of the format. Readers raise an
InputError for missing or invalid files; the message names the file and the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from pansplat.inputs import folder_formats as own
from pansplat.inputs import photographs, web_tours
from pansplat.inputs.panorama_sets import Collection
from pansplat.inputs.reconstructions import colmap, metashape, nerfstudio, openmvg, opensfm
from pansplat.inputs.reconstructions.shots import Reconstruction, make_collection

Read = Callable[[Path, Path, str | None], Collection]


@dataclass(frozen=True)
class Format:
    """A format of panoramas.

    Attributes:
        name: for people.
        find: the sources in a folder, each a collection: files, or the folder itself. They may be faulty. An OSError if
            the folder cannot be listed.
        read: the panoramas of a source, from the source, the folder in which it was found, and a pose convention.
        files: all files that state what is read of a source; they need not exist.
    """

    name: str
    find: Callable[[Path], list[Path]]
    read: Read
    files: Callable[[Path], Iterable[Path]] = lambda source: (source,)


def _named(name: str) -> Callable[[Path], list[Path]]:
    """Find a file of a name; the reader refuses what is no file."""
    return lambda folder: [folder / name] if (folder / name).exists() else []


def _reconstruction(read: Callable[[Path, Path, str | None], Reconstruction]) -> Read:
    return lambda *source: photographs.with_further(make_collection(read(*source)))


TRIPLETS = Format("game maps", own.find_triplets, own.read_triplet)
WEB_TOURS = Format("web tour", web_tours.find_web_tours, web_tours.read_web_tour)
PHOTOGRAPHS = Format("photographs", photographs.find_photographs, photographs.read_photographs)

POSED = (
    Format("poses.json", _named(own.POSES), own.read_pose_file, lambda file: (file, file.with_name(own.PAIRS))),
    Format("360Loc", _named(own.CAMERA_POSES), own.read_loc360_sequence),
    Format("PanoGRF", own.find_panogrf, own.read_panogrf_scene, own.list_panogrf_files),
    TRIPLETS,
    Format("nerfstudio", _named(nerfstudio.FILE), _reconstruction(nerfstudio.read_nerfstudio)),
    Format("openMVG", _named(openmvg.FILE), _reconstruction(openmvg.read_openmvg)),
    Format("OpenSfM", _named(opensfm.FILE), _reconstruction(opensfm.read_opensfm)),
    Format("COLMAP", colmap.find_colmap, _reconstruction(colmap.read_colmap), colmap.list_files),
    Format("Metashape", metashape.find_metashape, _reconstruction(metashape.read_metashape)),
)
"""Formats with poses. The first one of a folder is read."""

FORMATS = (*POSED, WEB_TOURS, PHOTOGRAPHS)
