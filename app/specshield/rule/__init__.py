"""What a formula says of a trajectory: its values, its robustness and the bounds on it."""
