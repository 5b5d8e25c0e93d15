"""Refinement: after a prediction, the scene is fitted to its own photographs by rendering and comparison."""

from pansplat.refinement.refinement import (
    DISPLAY_HEIGHT,
    RefineConfig,
    Refinement,
    RefineReport,
    refinement_fingerprint,
)

__all__ = ["DISPLAY_HEIGHT", "RefineConfig", "RefineReport", "Refinement", "refinement_fingerprint"]
