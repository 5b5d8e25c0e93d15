"""`pansplat predict`: a pair of panoramas to a file of Gaussians."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from pansplat.cli.inputs import (
    Compat,
    Out,
    PairChoice,
    Precision,
    choose_pair,
    predict_scene,
    progress_bar,
)
from pansplat.files import require_output_file
from pansplat.options import WHOLE, Fraction, Height, Range, Seconds

if TYPE_CHECKING:
    from pansplat.data.pairs import Pair
    from pansplat.predictor import Predictor

_MAX_CACHED_HEIGHT = 512  # networks write taller predictions tile by tile and do not cache them


@dataclass(frozen=True)
class Predict:
    """Predict the 3D Gaussians of a pair of panoramas and write them as a 3DGS .ply file."""

    path: Positional[Path]
    """Folder of the pair."""
    out: Out
    """The .ply file to write."""
    model: str = "default"
    """Predictor: `default`, `sweep` (without weights), or a file of weights (.safetensors, or an
    official .ckpt)."""
    compat: Compat = "trained"
    """For a network: official computes what the official code does, fixed corrects its defects; by default the one
    that the weights were trained with, which is official for official weights."""
    precision: Precision = "float32"
    """Number type of a network's convolutions; bfloat16 is less exact, and faster if the processor supports it."""
    height: Height | None = None
    """Panoramas are resized to this height, pixels; by default that of the photographs, at most 1024 (for networks
    512). Networks predict heights above 512 tile by tile, in bounded
    memory, and do not cache the result."""
    refine: Seconds = 0.0
    """Time limit of the refinement after the prediction, seconds; 0 for none. `pansplat refine` has more options."""
    degree: Annotated[int, Range(0, 4), WHOLE] | None = None
    """Highest degree of spherical harmonics to write, 0 to 4; by default all. The file of 4K panoramas has 5 GB with
    degree 4, 1 GB with degree 0."""
    min_opacity: Fraction = 0.0
    """Leave out Gaussians of lower opacity; those below 0.004 are invisible."""
    no_cache: bool = False
    """Predict again even if the pair's folder holds a cached result."""
    choice: PairChoice = field(default_factory=PairChoice)

    def run(self) -> int:
        """Predict, write the scene and print the time of the prediction."""
        from pansplat import pipeline

        require_output_file("--out", self.out, (".ply",))
        pair = choose_pair(self.path, self.choice)
        model = pipeline.load_model(self.model, compat=self.compat, precision=self.precision)
        began = time.perf_counter()
        count = self._predict(pair, model)
        seconds = time.perf_counter() - began
        names = ", ".join(panorama.name for panorama in pair.context)
        print(f"{self.out}: {count:,} Gaussians from {names} in {seconds:.1f} s")
        return 0

    def _predict(self, pair: Pair, model: Predictor) -> int:
        """Write the prediction, tile by tile if it is large, and return the number of Gaussians."""
        from pansplat import pipeline
        from pansplat.gaussians.scene import prune

        height = self.height or pipeline.choose_height(pair, model)
        if height > _MAX_CACHED_HEIGHT and not self.refine and pipeline.can_stream(model):
            with progress_bar() as progress:
                return pipeline.predict_to_file(
                    pair,
                    self.out,
                    model,
                    height=height,
                    degree=self.degree,
                    min_opacity=self.min_opacity,
                    progress=progress,
                )
        scene = predict_scene(pair, model, height, cache=not self.no_cache, refine_seconds=self.refine)
        gaussians = prune(scene.gaussians, degree=self.degree, min_opacity=self.min_opacity)
        pipeline.save(dataclasses.replace(scene, gaussians=gaussians), self.out)
        return len(gaussians)
