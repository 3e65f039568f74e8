"""What a formula says of a trajectory: its robustness and bounds, what is open, what is left of it."""
