"""Faults, again and again, while robots drive. Each row is a function of a `kills.Scene`."""
