"""Predictions and refinements in the store of their folder."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pansplat.gaussians.scene import Gains, Gaussians
from pansplat.inputs.content import hash_context
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Views
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, refinement_fingerprint
from pansplat.system.store import Store, hash_parts

_MAX_LEVELS = 256  # levels of Gaussians that an entry can have; their labels are bytes


@dataclass(frozen=True, eq=False)
class CachedScene:
    """Content of an entry.

    Attributes:
        gaussians, gains: see `Scene`.
    """

    gaussians: Gaussians
    gains: Gains = ()


class CachedPrediction:
    """The entry of one prediction, or of its refinement.

    Its key is that of the files, poses and depth range, the predictor's fingerprint, and the options.
    There is none of loaded panoramas, and without `PredictOptions.cache`.
    """

    def __init__(
        self, source: PanoramaSet | Views, predictor: Predictor, options: PredictOptions, *, refined: bool
    ) -> None:
        self._pair = source if isinstance(source, PanoramaSet) and options.cache else None
        self._kind = "refinement" if refined else "prediction"
        code = refinement_fingerprint(RefineConfig(gaussians=options.gaussians)) if refined else ""
        self._settings = [predictor.fingerprint, code, *options.describe(refined=refined)]
        self._key = self._make_key()
        self._store = Store(None if self._pair is None else self._pair.folder, (CachedScene, Gaussians))

    def _make_key(self) -> str:
        return "" if self._pair is None else hash_parts(hash_context(self._pair), *self._settings)

    def read(self) -> CachedScene | None:
        """The content; None if there is none."""
        count = 0 if self._pair is None else len(self._pair.context)
        return self._store.read(self._kind, self._key, lambda content: _is_valid(content, count))

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
