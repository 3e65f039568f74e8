"""Ways around what the tables do not know of."""
