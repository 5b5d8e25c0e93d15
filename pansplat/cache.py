"""Predictions and refinements in the store of their folder."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pansplat.gaussians.scene import Gains, Gaussians, Scene
from pansplat.inputs.content import hash_context
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Views
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, RefineReport, refinement_fingerprint
from pansplat.system.store import Store, hash_parts

_MAX_LEVELS = 256  # of Gaussians; their labels are bytes
_ENOUGH_STEPS = 40  # of a refinement; more change little
_STARVED_SHARE = 1 / 3  # of the processor's threads, below which a refinement of fewer steps is starved by load


@dataclass(frozen=True, eq=False)
class CachedScene:
    """Content of an entry.

    Attributes:
        gaussians, gains: see `Scene`.
        steps: of the refinement; 0 for a prediction.
        is_starved: whether the refinement did few steps because other processes had the processor.
    """

    gaussians: Gaussians
    gains: Gains = ()
    steps: int = 0
    is_starved: bool = False


class CachedPrediction:
    """The entry of one prediction, or of its refinement.

    Its key is that of the files, poses and depth range, the predictor's fingerprint, and the options.
    There is none of loaded panoramas, and without `PredictOptions.cache`.
    """

    def __init__(self, source: Pair | Views, predictor: Predictor, options: PredictOptions, *, refined: bool) -> None:
        self._pair = source if isinstance(source, Pair) and options.cache else None
        self._kind, self._found = "refinement" if refined else "prediction", None
        code = refinement_fingerprint(RefineConfig(gaussians=options.gaussians)) if refined else ""
        self._settings = [predictor.fingerprint, code, *options.describe(refined=refined)]
        self._key = self._make_key()
        self._store = Store(None if self._pair is None else self._pair.folder, (CachedScene, Gaussians))

    def _make_key(self) -> str:
        return "" if self._pair is None else hash_parts(hash_context(self._pair), *self._settings)

    def read(self) -> CachedScene | None:
        """The content; None if there is none."""
        count = 0 if self._pair is None else len(self._pair.context)
        self._found = self._store.read(self._kind, self._key, lambda content: _is_valid(content, count))
        return self._found

    def write_refinement(self, scene: Scene, report: RefineReport, processor_seconds: float) -> CachedScene:
        """Write a refinement, or what `read` has found if that has more steps; returns what is written.

        A refinement of few steps that shared the processor with other work is starved: it is to be run once more.
        """
        found, share = self._found, processor_seconds / (report.seconds * torch.get_num_threads())
        is_short = report.stopped == "done" and report.steps < _ENOUGH_STEPS and share < _STARVED_SHARE
        content = CachedScene(scene.gaussians, scene.gains, report.steps, is_short and found is None)
        if found is not None and found.steps > report.steps:
            content = replace(found, is_starved=False)
        self.write(content)
        return content

    def write(self, content: CachedScene) -> None:
        """Write the content, unless a file has changed since the key was made."""
        if self._make_key() == self._key:
            self._store.write(self._kind, self._key, content)


def _is_valid(content: object, num_views: int) -> bool:
    """Whether an entry holds values that predictors write; others would be wrong indices of views and levels."""
    if not isinstance(content, CachedScene):
        return False
    gaussians, gains = content.gaussians, torch.tensor(content.gains, dtype=torch.float64)
    floats = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    if not all(value.is_floating_point() and bool(value.isfinite().all()) for value in floats):
        return False
    for label, count in ((gaussians.levels, _MAX_LEVELS), (gaussians.views, num_views)):
        if label.is_floating_point() or label.is_complex() or label.dtype == torch.bool:
            return False
        if len(label) and not 0 <= int(label.min()) <= int(label.max()) < count:
            return False
    has_gains = gains.shape == (num_views, 3) and bool((gains.isfinite() & (gains > 0)).all())
    return has_gains or not content.gains
