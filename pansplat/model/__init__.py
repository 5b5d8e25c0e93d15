"""The PanSplat network: from posed panoramas to Gaussians.

`pansplat` consists of `feature_pyramid`, `mono_depth`, `cost_volume` and `heads`, in the order of the paper's Figure 3.
`weights` reads and writes its weights, and `network` makes predictors of them.
"""
