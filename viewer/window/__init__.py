"""The window, its events and the preferences of its user."""
