"""The HTTP contract, tried by schemathesis."""
