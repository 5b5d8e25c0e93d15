"""`pansplat predict`: panoramas to a file of Gaussians."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from tyro.conf import Positional

from pansplat.cli.inputs import Computation, Out, PairChoice, choose_source
from pansplat.prediction_options import PredictOptions
from pansplat.system.console import progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.files import SCENE_SUFFIXES, require_output_file


@dataclass(frozen=True)
class Predict(Computation):
    """Predict the 3D Gaussians of one panorama, a pair or a whole tour, and write them in the format of the file's
    suffix (docs/formats.md). Networks predict heights above 512 tile by tile, in bounded memory, and do not cache the
    result."""

    path: Positional[Path]
    """One panorama, a folder of panoramas, with or without poses, or a web tour."""
    out: Out
    """The file to write: .ply, .compressed.ply, .spz, .splat, .sog or .glb."""
    layers: bool = False
    """Keep all Gaussians of each view, for deferred blending. By default each surface is kept once, for programs that
    draw all Gaussians together (docs/formats.md). Networks keep all, and are not refined by default."""
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
        source = choose_source(self.path, self.choice)
        began, options = time.perf_counter(), replace(self.prediction, joint=not self.layers)
        count = pipeline.predict_to_file(source, self.out, options=options, degree=self.degree)
        seconds, views = time.perf_counter() - began, describe_count(len(source.panoramas), "panorama")
        print(f"{self.out}: {count:,} Gaussians of {views} in {seconds:.1f} s")
        return 0
