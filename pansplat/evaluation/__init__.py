"""Metrics, baselines, the paper's evaluations and tables, and the pose check."""
