"""Pure functions of tensors: directions, panoramas, lattices, cube faces, rigid poses."""
