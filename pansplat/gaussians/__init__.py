"""3D Gaussians, the scene they belong to, spherical harmonics, and .ply files."""
