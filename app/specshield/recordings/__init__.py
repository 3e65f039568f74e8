"""Writes sessions as files for other tools, and judges recorded drives by a rule."""
