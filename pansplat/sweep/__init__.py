"""A predictor without weights: a hierarchical sphere sweep.

In the order of the pipeline: `predictor` (the call), `search` (three levels), `planes` (the scene's axes and planes),
`prior` (depth that a model expects), `matching` (matching cost and its aggregation), `surface` (consistency between
views, upsampling), `lift` (Gaussians).
"""

from pansplat.sweep.predictor import Sweep, SweepConfig

__all__ = ["Sweep", "SweepConfig"]
