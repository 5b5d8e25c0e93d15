"""Predictions and refinements in the store of their folder."""

from __future__ import annotations

from dataclasses import dataclass

from pansplat.gaussians.scene import Gains, Gaussians
from pansplat.inputs.content import hash_context
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Views
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, refinement_fingerprint
from pansplat.system.store import Store, hash_parts


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
        return self._store.read(self._kind, self._key)

    def write(self, content: CachedScene) -> None:
        """Write the content, unless a file has changed since the key was made."""
        if self._make_key() == self._key:
            self._store.write(self._kind, self._key, content)
