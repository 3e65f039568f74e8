"""Why an answer is no: what cannot be kept, by how much, and whether that is proved."""
