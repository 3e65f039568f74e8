"""The maps and policies that a server keeps as files."""
