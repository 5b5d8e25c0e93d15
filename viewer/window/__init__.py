"""The window, its events and the paths that its user has opened."""
