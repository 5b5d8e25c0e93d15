"""Refinement: after a prediction, the scene is fitted to its own photographs by rendering and comparison."""

from pansplat.refinement.fusion import fuse_views
from pansplat.refinement.refinement import (
    DISPLAY_HEIGHT,
    RefineConfig,
    Refinement,
    RefineReport,
    refinement_fingerprint,
)

__all__ = ["DISPLAY_HEIGHT", "RefineConfig", "RefineReport", "Refinement", "fuse_views", "refinement_fingerprint"]
