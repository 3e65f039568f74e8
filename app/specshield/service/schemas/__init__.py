"""What the HTTP contract takes and gives."""
