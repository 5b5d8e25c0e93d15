"""Drawing Gaussians."""
