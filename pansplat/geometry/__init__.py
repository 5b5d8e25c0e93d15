"""Pure functions of tensors: panoramas, cube faces, lattices, rigid poses and paths, warping, correlation."""
