"""Training. Not here yet: `pansplat-train` says what will come."""
