"""GLSL sources of the viewer, read with importlib.resources."""
