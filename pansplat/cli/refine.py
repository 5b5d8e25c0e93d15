"""`pansplat refine`: a scene fitted to its own photographs."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Fixed, Positional, Suppress

from pansplat.cli.inputs import Computation, Out, PairChoice, choose_set, predict_scene
from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions
from pansplat.system.console import call_at_first_signal, progress_bar
from pansplat.system.files import SCENE_SUFFIXES, is_scene_file, require_output_file
from pansplat.system.options import Count, Positive, Seed
from pansplat.system.progress import report_progress, stage

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.views import Views
    from pansplat.refinement import RefineReport


@dataclass(frozen=True)
class _Prediction(PredictOptions):
    """The prediction of a pair. The photographs of a scene file have twice its rows by default, at most 1,024."""

    refine_steps: Annotated[int, Fixed, Suppress] = 0


@dataclass(frozen=True)
class Refine(Computation):
    """Fit a scene to its own photographs by rendering and comparison, and write it in the format of the file's suffix.

    Ctrl+C ends the refinement early and writes the scene as it is then.
    """

    path: Positional[Path]
    """A folder of two or more panoramas, or a scene file with --photographs."""
    out: Out
    """The file to write: .ply, .compressed.ply, .spz, .splat, .sog or .glb."""
    photographs: Path | None = None
    """Folder of the panoramas that a scene file was predicted from."""
    steps: Count | None = None
    """Number of steps; by default 80, with --layers 40."""
    seconds: Positive | None = None
    """Limit after which the run ends early, which is said; its result depends on the speed of the machine."""
    layers: bool = False
    """Keep all Gaussians of each view, for deferred blending. By default each surface is kept once, for programs that
    draw all Gaussians together (docs/formats.md)."""
    gaussians: Count | None = None
    """Largest number of Gaussians: similar neighbours are merged before the refinement."""
    poses: bool = False
    """Estimate small corrections of the camera poses, too; with --layers."""
    seed: Seed = 0
    """Of the blocks of pixels that are held out to detect overfitting."""
    prediction: _Prediction = field(default_factory=_Prediction)
    choice: PairChoice = field(default_factory=PairChoice)

    @progress_bar()
    def run(self) -> int:
        """Refine, write the scene and print the errors of held-out pixels."""
        from pansplat import pipeline
        from pansplat.refinement import RefineConfig, fuse_views

        self._refuse_invalid_arguments()
        with stage(0.5):
            given, views = self._open_scene()
        scene = given if self.layers else fuse_views(given)
        config = RefineConfig(gaussians=self.gaussians, poses=self.poses)
        with stop_at_interrupt() as should_stop:
            report_progress("preparing", 0.0)
            refined, report = pipeline.run_refinement(
                scene,
                views,
                config,
                self.seed,
                steps=self.steps,
                seconds=self.seconds or math.inf,
                should_stop=should_stop,
            )
            pipeline.save(refined, self.out)
        print(_describe(report, "all" if scene.joint else "held-out"))
        print(f"{self.out}: {len(refined.gaussians):,} Gaussians (given: {len(given.gaussians):,})")
        return 0

    def _refuse_invalid_arguments(self) -> None:
        """Raise an error before the prediction, which takes seconds."""
        require_output_file("--out", self.out, SCENE_SUFFIXES, overwrite=self.overwrite)
        if self.poses and not self.layers:
            raise InputError("--poses compares all Gaussians of each view with the photographs; add --layers")
        if is_scene_file(self.path) and self.photographs is None:
            raise InputError(f"{self.path} holds no photographs; give the folder of its pair with --photographs")
        if not is_scene_file(self.path) and self.photographs is not None:
            raise InputError(
                f"--photographs is for a scene file, and {self.path} is the folder of a pair; leave it out"
            )

    def _open_scene(self) -> tuple[Scene, Views]:
        """The scene of a file, or the prediction of a pair's folder, and its photographs."""
        from pansplat import pipeline

        if self.photographs is not None:
            scene = pipeline.load(self.path)
            pair = choose_set(self.photographs, self.choice)
            return scene, pipeline.load_photographs(pair, self.prediction.height or scene.height)
        pair = choose_set(self.path, self.choice)
        scene = predict_scene(pair, self.prediction)
        return scene, pipeline.load_photographs(pair, scene.height)


def _describe(report: RefineReport, compared: str) -> str:
    """One line on what the refinement did, with the errors of the compared pixels."""
    ending = {
        "done": "",
        "converged": ", converged",
        "interrupted": ", interrupted",
        "time limit": ", ended by --seconds",
        "single view": "; a single view is not refined",
        "torn": "; the given scene is kept, because pictures between the cameras would be torn",
        "worse": "; the given scene is kept, because the refined one is not better",
    }[report.stopped]
    if 0 < report.kept < report.steps:
        ending += f"; kept is the state after {report.kept}, whose pictures between the cameras are better"
    errors = f"{report.before:.4f} before, {report.after:.4f} after"
    return f"{report.steps} steps in {report.seconds:.1f} s{ending}; error of {compared} pixels {errors}"


@contextmanager
def stop_at_interrupt() -> Iterator[Callable[[], bool]]:
    """A function that returns True after the first Ctrl+C; the second one raises KeyboardInterrupt."""
    received: list[int] = []
    with call_at_first_signal((signal.SIGINT,), received.append):
        yield lambda: bool(received)
