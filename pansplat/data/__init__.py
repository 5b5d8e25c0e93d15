"""Reading posed panoramas from files, and writing pictures."""
