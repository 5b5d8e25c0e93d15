"""The PanSplat network and the MVSplat baseline: from posed panoramas to Gaussians.

`pansplat` consists of `feature_pyramid`, `mono_depth`, `cost_volume` and `heads`, in the order of the paper's Figure 3.
`mvsplat` is the baseline. `weights` reads and writes the weights of both, and `network` makes predictors of them.
"""
