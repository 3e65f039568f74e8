"""The page of sessions whose robot or map is not as they were told: campaigns, figures, text."""
