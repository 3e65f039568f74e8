"""The commands of `specshield` that have a module of their own."""
