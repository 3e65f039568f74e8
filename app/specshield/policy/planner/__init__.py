"""pi_phi for any formula: a plan at every decision."""
