"""Limits on what callers may use: connections, headers, bytes of bodies, and the time to send them."""
