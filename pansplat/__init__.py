"""pansplat: a few 360-degree panoramas in, a scene of spherical 3D Gaussians you can fly through out."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

__version__ = "0.1.0"

# Resolved on first use, so that `import pansplat` (and `pansplat --help`) does not wait for torch.
_PUBLIC = {
    "Gaussians": "pansplat.gaussians.gaussians",
    "InputError": "pansplat.errors",
    "Pair": "pansplat.data.pairs",
    "Rendering": "pansplat.render",
    "Scene": "pansplat.gaussians.scene",
    "Views": "pansplat.data.views",
    "load": "pansplat.pipeline",
    "load_model": "pansplat.pipeline",
    "load_pairs": "pansplat.pipeline",
    "predict": "pansplat.pipeline",
    "predict_to_file": "pansplat.pipeline",
    "rasterize": "pansplat.render",
    "render": "pansplat.pipeline",
    "save": "pansplat.pipeline",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'pansplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})


class _Package(ModuleType):
    """Keeps `pansplat.render` the call: importing the room of that name would put the module in its place."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _PUBLIC and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
