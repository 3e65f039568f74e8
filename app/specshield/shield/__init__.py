"""The shield: feasibility of actions, the shaped distribution, and Algorithm 1."""
