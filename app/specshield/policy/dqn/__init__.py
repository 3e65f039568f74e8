"""pi_phi by deep Q-learning (paper, section IV-A)."""
