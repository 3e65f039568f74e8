"""How the stand-in for a foundation model is trained."""
