"""Simulated robots and foundation models, the paper's cases, campaigns."""
