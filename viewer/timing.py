"""`python -m pansplat_viewer.timing JOB.json`: how long the viewer's renderer takes for pictures, and the pictures.

For programs that compare renderers, such as `pansplat bench raster`; they run it as a command, since nothing may
import the viewer. Needs no window. A job is

    {"scene": "scene.ply", "pose": 4x4 cam2world, "size": [width, height], "repeats": 5, "folder": "pictures",
     "tiers": ["gl33", "gl43"], "settings": [{"kernel": "ray", "layout": "equirect", ...}, ...]}

with the fields of `DrawSettings`. For each tier and settings one line of JSON goes to standard output:

    {"tier": "gl33", "settings": 0, "renderer": "llvmpipe ...", "frame_ms": [...], "sort_ms": 3.1, "picture": FILE.npy}

`frame_ms` are frames of a moving camera, the sort included. Tiers that the context lacks are passed over. The
picture is float32, RGB and coverage, top row first.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pansplat.errors import InputError
from pansplat.gaussians.ply import load_ply
from pansplat.gaussians.scene import Scene
from pansplat_viewer.draw import choose_tier
from pansplat_viewer.offscreen import create_context
from pansplat_viewer.renderer import DrawSettings, SplatRenderer

_STEP = 1e-4  # metres that the camera moves between frames, so that nothing is kept from the last one


def main() -> int:
    """Run the job named on the command line: 0 done, 2 it cannot be used or there is no OpenGL."""
    try:
        for line in run_job(json.loads(Path(sys.argv[1]).read_text())):
            print(json.dumps(line), flush=True)
    except (InputError, OSError, IndexError, KeyError, TypeError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run_job(job: dict[str, Any]) -> Iterator[dict[str, object]]:
    """The lines of a job, each as soon as it is measured.

    Raises:
        InputError: there is no OpenGL, the scene cannot be read, or a setting is none.
    """
    scene, pose = load_ply(job["scene"]), np.asarray(job["pose"], np.float64)
    settings = [DrawSettings(**values) for values in job["settings"]]
    ctx = create_context()
    try:
        for tier in job["tiers"]:
            try:
                choose_tier(ctx, tier)
            except InputError:
                continue
            renderer = SplatRenderer(ctx, tier=tier, color_bits=32)
            try:
                for index, one in enumerate(settings):
                    file = Path(job["folder"]) / f"{tier}_{index}.npy"
                    measured = _measure(renderer, scene, pose, tuple(job["size"]), one, job["repeats"], file)
                    yield {"tier": tier, "settings": index, "renderer": ctx.info["GL_RENDERER"], **measured}
            finally:
                renderer.release()
    finally:
        ctx.release()


def _measure(
    renderer: SplatRenderer,
    scene: Scene,
    pose: np.ndarray,
    size: tuple[int, int],
    settings: DrawSettings,
    repeats: int,
    file: Path,
) -> dict[str, object]:
    """Frames on a short walk that ends at the pose, and the picture there."""
    if renderer.num_views == 0:
        renderer.upload(scene)
    frames, sorts = [], []
    for index in range(repeats, -1, -1):
        place = pose.copy()
        place[0, 3] += index * _STEP
        renderer.render(place, size, settings)
        frames.append(renderer.stats.frame_ms)
        sorts.append(renderer.stats.sort_ms)
    np.save(file, renderer.read_color())
    # The first frame compiles shaders and allocates.
    return {"frame_ms": frames[1:], "sort_ms": float(np.median(sorts[1:])), "picture": str(file)}


if __name__ == "__main__":
    sys.exit(main())
