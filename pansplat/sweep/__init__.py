"""A predictor that needs no weights: a hierarchical spherical plane sweep.

Read it top to bottom: `predictor` (the call), `search` (three levels), `frame` (the scene's axes), `cost`
(matching), `votes` and `planes` (the scene's planes), `aggregate` (smoothing), `surface` (what views tell each other),
`lift` (Gaussians).
"""

from pansplat.sweep.predictor import Sweep, SweepConfig

__all__ = ["Sweep", "SweepConfig"]
