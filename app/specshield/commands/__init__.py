"""Commands of `specshield` that are not in cli.py."""
