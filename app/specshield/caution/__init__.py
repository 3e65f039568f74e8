"""What J asks for beyond satisfaction, and how a session learns how much of it the robot needs."""
