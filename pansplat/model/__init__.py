"""The PanSplat network: from posed panoramas to Gaussians.

`pansplat` consists of `feature_pyramid`, `mono_depth`, `cost_volume` and `heads`, in the order of the paper's Figure 3.
`network` makes predictors of its weights, which `official_weights` converts from official checkpoints.
"""
