"""Metrics, baselines, reports, and the pose self-check."""
