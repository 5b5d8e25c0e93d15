"""Folders of panoramas with and without poses, reconstructions and web tours as `Pair` and `Collection`."""
