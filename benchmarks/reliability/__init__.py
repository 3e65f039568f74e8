"""What the service promises under faults, load and hostile input, tried: see docs/reliability.md."""
