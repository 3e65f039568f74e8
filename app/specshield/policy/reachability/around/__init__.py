"""Ways around obstacles that the tables do not know of."""
