"""A preference inside the feasible set: what each action will cost the model later."""
