"""Where sessions are kept: a Redis-protocol server, our own or another's."""
