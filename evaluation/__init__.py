"""Campaigns, statistics, figures, the write-up, and the training of the stand-in model."""
