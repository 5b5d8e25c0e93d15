"""What is shown: scenes, tours, cameras and settings."""
