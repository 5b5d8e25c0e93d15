"""Rooms made from a seed: layout, furniture, materials and a ray caster to see them with."""
