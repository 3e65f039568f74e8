"""Sessions: what the store holds of an episode, and what each request changes in it."""
