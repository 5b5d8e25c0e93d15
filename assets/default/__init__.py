"""The weights of the default model; see MODEL.md."""
