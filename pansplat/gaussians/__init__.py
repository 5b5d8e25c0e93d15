"""3D Gaussians, the scene they belong to, spherical harmonics, and scene files."""
