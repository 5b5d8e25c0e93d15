"""Renderers: OpenGL and CPU."""
