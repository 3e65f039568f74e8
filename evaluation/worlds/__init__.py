"""Worlds that are not as told: how much of what an oracle could keep is kept by a session that learns."""
