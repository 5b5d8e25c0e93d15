"""Predictors: posed panoramas in, Gaussians out."""
