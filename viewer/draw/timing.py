"""`python -m pansplat_viewer.draw.timing JOB.json` measures the renderer and writes its images.

`pansplat bench viewer` runs this command, because no other package may import the viewer. Needs no window. A job is

    {"scene": "scene.ply", "pose": 4x4 cam2world, "size": [width, height], "repeats": 5, "folder": "images",
     "renderers": ["gl", "cpu"], "settings": [{"mode": "joint", ...}, ...]}

with the fields of `DrawSettings`, and optionally a "size" of its own. For each renderer and settings, one line of JSON
is printed:

    {"renderer": "gl", "settings": 0, "device": "llvmpipe ...", "frame_ms": [...], "sort_ms": 3.1,
     "stages": {"project": 2.1, ...}, "image": FILE.npy}

`frame_ms` are times of frames of a moving camera and include the sort; with "cached" the camera turns in place.
`stages` are medians in milliseconds. The image is float32, RGB and coverage, top row first; of `cpu` with "cached" it
is what the screen shows, with 8 bits.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pansplat.errors import InputError
from pansplat.gaussians.ply import load_ply
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.draw.offscreen import create_context
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer

_TURN_RADIANS = 5e-3  # angle between two frames of a camera that turns
_STEP = 1e-4  # distance between two frames of a camera that moves, metres, so that no layer is reused


def main() -> int:
    """Run the job file named on the command line; returns 0, or 2 if the job is invalid or OpenGL is missing."""
    try:
        for line in run_job(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))):
            print(json.dumps(line), flush=True)
    except (InputError, OSError, IndexError, KeyError, TypeError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run_job(job: dict[str, Any]) -> Iterator[dict[str, object]]:
    """Yield the result lines of a job."""
    scene, pose = load_ply(job["scene"]), np.asarray(job["pose"], np.float64)
    sizes = [tuple(values.get("size", job["size"])) for values in job["settings"]]
    settings = [
        DrawSettings(**{key: value for key, value in values.items() if key != "size"}) for values in job["settings"]
    ]
    ctx = create_context()
    try:
        for name in job["renderers"]:
            renderer = CpuRenderer(ctx) if name == "cpu" else SplatRenderer(ctx, color_bits=32)
            try:
                renderer.upload(scene)
                for index, (each, size) in enumerate(zip(settings, sizes, strict=True)):
                    file = Path(job["folder"]) / f"{name}_{index}.npy"
                    measured = _measure(renderer, pose, size, each, job["repeats"], file)
                    device = "numba" if name == "cpu" else ctx.info["GL_RENDERER"]
                    yield {"renderer": name, "settings": index, "device": device, **measured}
            finally:
                renderer.release()
    finally:
        ctx.release()


def _measure(
    renderer: FrameRenderer,
    pose: np.ndarray,
    size: tuple[int, int],
    settings: DrawSettings,
    repeats: int,
    file: Path,
) -> dict[str, object]:
    """Render along a short path, or turn, to the pose, and write the last image."""
    frames: list[float] = []
    stages: list[Mapping[str, float]] = []
    for index in range(repeats, -1, -1):
        moved = pose.copy()
        if settings.cached:
            angle = index * _TURN_RADIANS
            turn = np.array(((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle))))
            moved[:3, :3] = turn @ pose[:3, :3]
        else:
            moved[0, 3] += index * _STEP
        texture = renderer.render(moved, size, settings)
        stats = renderer.stats
        frames.append(stats.frame_ms)
        sort = {"sort": stats.sort_ms, "draw": max(stats.frame_ms - stats.sort_ms, 0.0)}
        stages.append(stats.stages or sort)
    if settings.cached and isinstance(renderer, CpuRenderer) and texture is not None:
        pixels = np.frombuffer(texture.read(), np.uint8).reshape(*size[::-1], 4)[::-1]
        np.save(file, pixels.astype(np.float32) / 255)
    else:
        np.save(file, renderer.read_color())
    # The first frame compiles shaders and allocates buffers, or draws the cube faces.
    names = dict.fromkeys(name for each in stages[1:] for name in each)
    medians = {name: float(np.median([each.get(name, 0.0) for each in stages[1:]])) for name in names}
    sort_ms = medians.get("sort", 0.0)
    return {"frame_ms": frames[1:], "sort_ms": sort_ms, "stages": medians, "image": str(file)}


if __name__ == "__main__":
    sys.exit(main())
