"""What a formula says of a trajectory: its leaves and bounds, its progress, what is left of it."""
