"""pansplat: a few 360-degree panoramas in, a scene of spherical 3D Gaussians you can fly through out."""

import os
import sys
from importlib import import_module
from typing import Any

# Threads of torch's operations sleep while they wait. By default they spin for milliseconds: beside another process, an
# operation of half a millisecond on two threads takes six to nineteen.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "1.0.0"

# Resolved at first use: `import pansplat` and `pansplat --help` must not import torch.
_PUBLIC = {
    "Gaussians": "pansplat.gaussians.scene",
    "InputError": "pansplat.errors",
    "PanoramaSet": "pansplat.inputs.panorama_sets",
    "Rendering": "pansplat.rendering",
    "Scene": "pansplat.gaussians.scene",
    "Views": "pansplat.inputs.views",
    "estimate_poses": "pansplat.poses.estimate",
    "load": "pansplat.pipeline",
    "load_model": "pansplat.pipeline",
    "load_sets": "pansplat.pipeline",
    "predict": "pansplat.pipeline",
    "predict_to_file": "pansplat.pipeline",
    "fuse": "pansplat.pipeline",
    "predict_tour": "pansplat.pipeline",
    "rasterize": "pansplat.rendering",
    "refine": "pansplat.pipeline",
    "render": "pansplat.pipeline",
    "save": "pansplat.pipeline",
    "show": "pansplat.notebook",
    "show_progress": "pansplat.system.progress",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'pansplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


def _register_displays() -> None:
    """In the kernel of a notebook, show pictures and viewers (pansplat.notebook)."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if getattr(shell, "kernel", None) is not None:
        import_module("pansplat.notebook").register_displays(shell.display_formatter)


_register_displays()
