"""Files of pictures: panoramas, faces of cubes, cameras of rigs, masks, videos and their metadata."""
