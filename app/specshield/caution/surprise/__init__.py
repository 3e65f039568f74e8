"""What steps that go otherwise than foreseen say of the map, and what is done if no future keeps the rule."""
