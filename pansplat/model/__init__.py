"""The PanSplat network and the MVSplat baseline: posed panoramas in, Gaussians out.

In the order of the paper's Figure 3: `feature_pyramid`, `mono_depth`, `cost_volume` and `heads` are the parts of
`pansplat`; `mvsplat` is the baseline; `weights` reads and writes their files; `network` makes a predictor of either.
"""
