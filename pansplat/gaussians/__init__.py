"""What a predictor makes and a renderer draws: 3D Gaussians, and the scene they belong to."""
