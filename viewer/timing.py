"""`python -m pansplat_viewer.timing JOB.json` measures the renderer and writes its images.

`pansplat bench raster` runs this command, because no other package may import the viewer. Needs no window. A job is

    {"scene": "scene.ply", "pose": 4x4 cam2world, "size": [width, height], "repeats": 5, "folder": "images",
     "tiers": ["gl33", "gl43"], "settings": [{"kernel": "ray", "layout": "equirect", ...}, ...]}

with the fields of `DrawSettings`. For each tier and settings, one line of JSON is printed:

    {"tier": "gl33", "settings": 0, "renderer": "llvmpipe ...", "frame_ms": [...], "sort_ms": 3.1, "image": FILE.npy}

`frame_ms` are times of frames of a moving camera and include the sort. Tiers that the context does not support are
skipped. The image is float32, RGB and coverage, top row first.
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
from pansplat_viewer.offscreen import create_context
from pansplat_viewer.programs import choose_tier
from pansplat_viewer.renderer import DrawSettings, SplatRenderer

_STEP = 1e-4  # metres that the camera moves between frames, so that no layer is reused


def main() -> int:
    """Run the job file named on the command line; returns 0, or 2 if the job is invalid or OpenGL is missing."""
    try:
        for line in run_job(json.loads(Path(sys.argv[1]).read_text())):
            print(json.dumps(line), flush=True)
    except (InputError, OSError, IndexError, KeyError, TypeError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run_job(job: dict[str, Any]) -> Iterator[dict[str, object]]:
    """Yield the result lines of a job.

    Raises:
        InputError: OpenGL is missing, the scene cannot be read, or a setting is invalid.
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
                for index, each in enumerate(settings):
                    file = Path(job["folder"]) / f"{tier}_{index}.npy"
                    measured = _measure(renderer, scene, pose, tuple(job["size"]), each, job["repeats"], file)
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
    """Render along a short path that ends at the pose, and write the last image."""
    if renderer.num_views == 0:
        renderer.upload(scene)
    frames, sorts = [], []
    for index in range(repeats, -1, -1):
        moved = pose.copy()
        moved[0, 3] += index * _STEP
        renderer.render(moved, size, settings)
        frames.append(renderer.stats.frame_ms)
        sorts.append(renderer.stats.sort_ms)
    np.save(file, renderer.read_color())
    # The first frame compiles shaders and allocates buffers.
    return {"frame_ms": frames[1:], "sort_ms": float(np.median(sorts[1:])), "image": str(file)}


if __name__ == "__main__":
    sys.exit(main())
