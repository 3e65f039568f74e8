"""Worlds that differ from the description: what a session that learns keeps of what an oracle could."""
