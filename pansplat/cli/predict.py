"""`pansplat predict`: one panorama or a pair to a file of Gaussians."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from tyro.conf import Positional

from pansplat.cli.inputs import Computation, Out, PairChoice, choose_set
from pansplat.prediction_options import PredictOptions
from pansplat.system.console import progress_bar
from pansplat.system.files import SCENE_SUFFIXES, require_output_file


@dataclass(frozen=True)
class Predict(Computation):
    """Predict the 3D Gaussians of one panorama or of a pair, and write them in the format of the file's suffix
    (docs/formats.md). Networks predict heights above 512 tile by tile, in bounded memory, and do not cache the
    result."""

    path: Positional[Path]
    """One panorama, a folder of panoramas, or a web tour; of several pairs the first, or that of --pair."""
    out: Out
    """The file to write: .ply, .compressed.ply, .spz, .splat, .sog or .glb."""
    layers: bool = False
    """Keep all Gaussians of each view, for deferred blending. By default each surface is kept once, for programs that
    draw all Gaussians together (docs/formats.md). Networks keep all. What keeps all is not refined
    by default."""
    degree: Annotated[int, Meta(ge=0, le=4)] | None = None
    """Highest degree of spherical harmonics to write, 0 to 4; by default all that the format holds. The .ply of 4K
    panoramas has 5 GB with degree 4, 1 GB with degree 0."""
    prediction: PredictOptions = field(default_factory=PredictOptions)
    choice: PairChoice = field(default_factory=PairChoice)

    @progress_bar()
    def run(self) -> int:
        """Predict, write the scene and print the time of the prediction."""
        from pansplat import pipeline

        require_output_file("--out", self.out, SCENE_SUFFIXES, overwrite=self.overwrite)
        pair = choose_set(self.path, self.choice)
        model = pipeline.load_predictor(self.prediction)
        joint = not self.layers and len(pair.context) > 1 and not pipeline.can_stream(model)
        options = replace(self.prediction, joint=joint)
        if options.refine_steps is None and not joint:
            options = replace(options, refine_steps=0)
        began = time.perf_counter()
        count = pipeline.predict_to_file(pair, self.out, model, options=options, degree=self.degree)
        seconds = time.perf_counter() - began
        names = ", ".join(panorama.name for panorama in pair.context)
        print(f"{self.out}: {count:,} Gaussians from {names} in {seconds:.1f} s")
        return 0
