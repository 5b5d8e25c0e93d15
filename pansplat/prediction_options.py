"""Options of reading and of prediction: the arguments of commands, and the keywords of the functions of `pipeline`.

Imports no torch, so that `--help` is fast.
"""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Fixed, Suppress, arg

from pansplat.errors import InputError
from pansplat.system.options import CAMERA_HEIGHT, Count, CountOrNone, Depth, Height, Positive

CompatChoice = Literal["trained", "official", "fixed"]
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class ReadOptions:
    """How panoramas are read."""

    # The names are those of the keywords of `pansplat.load_sets`.
    convention: str | None = None
    """Pose convention; overrides that of the files: "cam2world opencv", "cam2world opengl",
    "world2cam opencv" or "world2cam opengl" (Habitat and Blender use opengl)."""
    near: Depth | None = None
    """Nearest depth to search, metres; by default the folder's."""
    far: Depth | None = None
    """Farthest depth to search, metres; by default the folder's."""
    camera_height: Positive = CAMERA_HEIGHT
    """Height of the cameras over the floor, metres: the scale of a single photograph, and of a folder without poses."""


@dataclass(frozen=True)
class PredictOptions:
    """How the scene of panoramas is predicted and refined."""

    # The names are those of the keywords of `pansplat.predict`, which documents those that no command has.
    model: str = "default"
    """Predictor, for a pair: `default`, `sweep` (without weights), or a file of weights (.safetensors, or an official
    .ckpt)."""
    compat: CompatChoice = "trained"
    """For a network: official computes what the official code does, fixed corrects its defects; by default the one
    that the weights were trained with, which is official for official weights."""
    precision: Precision = "float32"
    """Number type of a network's convolutions; bfloat16 is less exact, and faster if the processor supports it."""
    depth_network: Path | None = None
    """For the model default: an ONNX file of a network of relative depth, whose edges the surfaces then have
    (docs/depth_network.md); it needs onnxruntime, the extra `onnx`."""
    height: Height | None = None
    """Panoramas are resized to this height before the prediction, pixels; by default that of the photographs, at
    most 1024 (for networks and tours 512)."""
    refine_steps: Annotated[CountOrNone | None, arg(name="refine")] = None
    """Steps of the refinement after the prediction; 0 for none. By default 40; where each surface
    is kept once 80, or 8 for each panorama of a tour."""
    gaussians: Annotated[Count | None, Fixed, Suppress] = None
    joint: Annotated[bool, Fixed, Suppress] = False
    cache: bool = True
    """Read results, poses too, from the folder of the panoramas, and keep them there; --no-cache does neither."""

    def replace(self, **changes: Any) -> PredictOptions:
        """The options with other values; an InputError for what is no option."""
        names = [field.name for field in dataclasses.fields(PredictOptions)]
        for name in changes.keys() - names:
            near = "".join(f" (did you mean {each}?)" for each in get_close_matches(name, names, n=1))
            raise InputError(f"needed an option of a prediction, got {name!r}{near}; they are {', '.join(names)}")
        return dataclasses.replace(self, **changes)

    def describe(self, *, refined: bool) -> list[str]:
        """What a prediction or its refinement depends on, beside its input and its predictor: for the cache's key."""
        omitted = {*_OF_PREDICTOR, *(() if refined else _OF_REFINEMENT), "cache"}
        return [f"{name} {value}" for name, value in vars(self).items() if name not in omitted]


_OF_PREDICTOR = "model", "compat", "precision", "depth_network"  # parts of its fingerprint
_OF_REFINEMENT = "refine_steps", "gaussians", "joint"


def choose_caches(command: Any) -> AbstractContextManager[None]:
    """A block without caches if options of a prediction, alone or among those of a command, have `--no-cache`."""
    nested = [command]
    for each in nested:
        nested += filter(dataclasses.is_dataclass, vars(each).values())
    if all(getattr(each, "cache", True) for each in nested):
        return nullcontext()
    from pansplat.system.store import without_caches

    return without_caches()
