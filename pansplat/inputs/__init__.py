"""Folders of panoramas with and without poses, reconstructions and web tours as `PanoramaSet` and `Collection`."""
