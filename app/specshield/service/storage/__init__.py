"""Where sessions are kept: a store of the Redis protocol, the server's own or another one, and an archive."""
