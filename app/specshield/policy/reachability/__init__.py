"""pi_phi by backward dynamic programming over pose and progress."""
