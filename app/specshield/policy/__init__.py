"""pi_phi: policies made to satisfy a formula, learned or computed, and what they propose."""
