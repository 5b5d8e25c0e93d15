"""What needs neither window nor OpenGL: scenes, tours, cameras, state and settings."""
