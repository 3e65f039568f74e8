"""Which futures are tried, what J asks for beyond satisfaction, what a session learns of robot and map."""
