"""Screenshots: numbered files that never overwrite one another."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pansplat.data.images import write_image


def free_name(folder: Path, stem: str, suffix: str) -> Path:
    """The first of `stem_001.suffix`, `stem_002.suffix`, ... that is not there."""
    number = 1
    while (path := folder / f"{stem}_{number:03d}.{suffix}").exists():
        number += 1
    return path


def write_screenshot(
    folder: Path,
    suffix: str,
    color: Float[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "height width"] | None = None,
    *,
    panorama: bool = False,
) -> Path:
    """Write a picture (RGB in [0, 1]) as PNG, or as EXR with radial depth in metres; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = free_name(folder, "panorama" if panorama else "view", suffix)
    write_image(path, np.clip(color, 0, 1), depth=depth, panorama=panorama)
    return path
