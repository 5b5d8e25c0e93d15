"""Posed pictures of structure-from-motion programs as panoramas: nerfstudio, COLMAP, openMVG, OpenSfM, Metashape.

Each format has a module that reads its file; `shots` makes panoramas of the pictures. `dataset` writes cube faces with
a transforms.json and a model of COLMAP.
"""

from __future__ import annotations

from pathlib import Path

from pansplat.inputs.pairs import Collection
from pansplat.inputs.reconstructions import nerfstudio, openmvg, opensfm
from pansplat.inputs.reconstructions.colmap import find_colmap, read_colmap
from pansplat.inputs.reconstructions.metashape import find_metashape, read_metashape
from pansplat.inputs.reconstructions.shots import make_collection

_READERS = {
    nerfstudio.FILE: nerfstudio.read_nerfstudio,
    openmvg.FILE: openmvg.read_openmvg,
    opensfm.FILE: opensfm.read_opensfm,
}


def find_reconstruction(folder: Path) -> Path | None:
    """The file in a folder, or of the COLMAP model in it, that states poses; None if there is none. It may be faulty.

    Raises:
        OSError: the folder cannot be listed.
    """
    found = next((folder / name for name in _READERS if (folder / name).is_file()), None)
    return found or find_colmap(folder) or find_metashape(folder)


def read_reconstruction(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The posed panoramas of a file of `find_reconstruction`.

    Args:
        source: the file.
        folder: in which it was found.
        convention: pose convention; overrides that of the format.
    """
    if source.name in _READERS:
        found = _READERS[source.name](source, convention)
    elif source.suffix.lower() == ".xml":
        found = read_metashape(source, convention)
    else:
        found = read_colmap(source, folder, convention)
    return make_collection(found)
