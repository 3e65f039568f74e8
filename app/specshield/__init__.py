"""specshield keeps robot foundation models inside their operating rules."""

__version__ = "0.2.0.dev0"
