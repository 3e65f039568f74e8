"""The pages of results: one that summarises, and one for each kind of experiment."""
