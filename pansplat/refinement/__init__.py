"""Refinement: after a prediction, the scene is fitted to its own photographs by rendering and comparison."""

from pansplat.refinement.refinement import RefineConfig, Refinement, RefineReport, refinement_fingerprint

__all__ = ["RefineConfig", "RefineReport", "Refinement", "refinement_fingerprint"]
