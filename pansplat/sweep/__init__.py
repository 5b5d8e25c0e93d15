"""A hierarchical sphere sweep: without weights the predictor `sweep`, with the prior of a depth network `default`.

In the order of the pipeline: `predictor` (the call), `search` (observation, then three levels), `axes` (of the scene),
`prior` (depth that a model expects), `matching` (matching cost and its aggregation), `bend` (single views, bent by
matches, over `smoothing`), `whole` (surfaces without holes), `lift` (Gaussians). They use `surface` (consistency
between views, upsampling) and `panoramas` (as numpy arrays). `guided_sweep` loads the networks of the prior;
`joined_crops` joins the depth of a user's network.
"""

from pansplat.sweep.predictor import Sweep

__all__ = ["Sweep"]
