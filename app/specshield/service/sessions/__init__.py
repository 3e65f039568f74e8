"""Sessions: what is stored of an episode, and what a request does to it."""
