"""Layers and weights of all networks, and the networks that are not the paper's: depth of panoramas, matching."""
