"""Furnished rooms that are generated from a seed, and a ray tracer that renders them."""
