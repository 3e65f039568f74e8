"""Policies in the making: jobs and workers."""
