"""What a decision costs beside the paper's algorithm written plainly: `make bench`."""
