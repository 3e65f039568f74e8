"""What a world that is not as told says of the map, and what is kept where the rule is lost."""
