"""Homes that are generated from a seed, and how the shipped weights were trained on them (README.md)."""
