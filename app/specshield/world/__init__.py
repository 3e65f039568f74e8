"""The floor: which cells are taken, named areas, and distances."""
