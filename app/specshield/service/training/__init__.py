"""Policies in the making: jobs, workers, methods."""
