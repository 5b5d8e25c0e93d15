"""Benchmarks of speed, memory and error."""
