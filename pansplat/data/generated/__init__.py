"""Rooms made from a seed: layout, furniture, surfaces and a ray caster to see them with."""
