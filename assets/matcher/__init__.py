"""The weights of the learned matcher; see MODEL.md."""
