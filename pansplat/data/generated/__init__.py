"""Homes that are generated from a seed, cameras in them, and a ray tracer that renders them."""
