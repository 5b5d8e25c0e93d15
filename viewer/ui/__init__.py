"""Panels, overlays and the image on the screen."""
