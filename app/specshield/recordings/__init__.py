"""Sessions as files that other tools open, and drives of others judged by a rule."""
