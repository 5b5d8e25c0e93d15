"""Reading posed panoramas and training samples from files; writing images and videos."""
