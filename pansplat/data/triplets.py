"""Rendered triplets on disk: PanoGRF's folders and those of game maps. Files are read when a triplet is asked for.

Source: OFFICIAL.md 2.1 and 13.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pansplat.data.game_maps import read_triplet, triplet_files
from pansplat.data.matterport3d import is_matterport3d_scene, read_matterport3d_scene
from pansplat.data.pair import Pair
from pansplat.errors import InputError

Stage = Literal["train", "val", "test"]

TRAINING_SETS = (("m3d", 0.5),)
TEST_SETS = (
    ("m3d", 0.1),
    ("m3d", 0.25),
    ("m3d", 0.5),
    ("m3d", 0.75),
    ("m3d", 1.0),
    ("residential", 0.15),
    ("replica", 0.5),
)
"""Name of the scenes' data set, metres from an input to the middle view; the baseline is twice that."""


@dataclass(frozen=True)
class TripletSet:
    """Triplets of one kind.

    Attributes:
        name: such as "m3d_dist_0.5".
        folder: where they are, or would be.
        sources: a scene folder or a .json a triplet, sorted; none where the folder is missing.
    """

    name: str
    folder: Path
    sources: tuple[Path, ...]

    def pair(self, index: int) -> Pair:
        """The triplet of that number as a pair with a target; nothing that travels with the camera is looked for.

        Raises:
            InputError: a file is missing or wrong.
        """
        source = self.sources[index]
        collection = read_triplet(source) if source.is_file() else read_matterport3d_scene(source)
        (pair,) = collection.pairs(source if source.is_dir() else source.parent)
        if not pair.targets:
            raise InputError(f"{source}: needed three views (two inputs and a target between), got two; add one.")
        return dataclasses.replace(pair, siblings=())


def panogrf_folder(root: Path | str, stage: Stage, name: str, distance: float, height: int) -> Path:
    """Where PanoGRF's triplets of that kind are; heights up to 512 read the 1024x512 folder."""
    rows = max(height, 512)
    return Path(root) / f"png_render_{stage}_{2 * rows}x{rows}_seq_len_3_{name}_dist_{distance}"


def read_panogrf(
    root: Path | str, stage: Stage, height: int, sets: Sequence[tuple[str, float]] | None = None
) -> list[TripletSet]:
    """PanoGRF's triplets below a folder, one set a kind; a missing kind is an empty set, and a warning says so.

    Args:
        root: the folder that holds png_render_{stage}_... folders.
        stage: train and val have m3d at 0.5 m only.
        height: of the panoramas wanted, pixels.
        sets: name and distance of each kind; None for all of the stage.

    Raises:
        InputError: none of them is there.
    """
    root = Path(root).expanduser()
    kinds = sets if sets is not None else TEST_SETS if stage == "test" else TRAINING_SETS
    found = []
    for name, distance in kinds:
        folder = panogrf_folder(root, stage, name, distance, height)
        scenes = sorted(folder.iterdir()) if folder.is_dir() else []
        scenes = [scene for scene in scenes if scene.is_dir() and is_matterport3d_scene(scene)]
        found.append(TripletSet(f"{name}_dist_{distance}", folder, tuple(scenes)))
    missing = [str(triplets.folder) for triplets in found if not triplets.sources]
    if len(missing) == len(found):
        raise InputError(
            f"{root}: needed PanoGRF scenes for {stage}, got none in {', '.join(missing)}; give the folder that holds "
            "these, or fetch them."
        )
    if missing:
        warnings.warn(f"no PanoGRF scenes in {', '.join(missing)}; going on without them.", stacklevel=2)
    return found


def read_game_maps(folder: Path | str) -> TripletSet:
    """The triplets NAME.json of a folder.

    Raises:
        InputError: there is none.
    """
    folder = Path(folder).expanduser()
    sources = tuple(triplet_files(folder))
    if not sources:
        raise InputError(
            f"{folder}: needed triplets (NAME.json with NAME_0.png beside it), got none; see docs/input.md."
        )
    return TripletSet(folder.resolve().name, folder, sources)
