"""The `pansplat` command."""
