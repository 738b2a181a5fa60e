"""Episodes that run in the studio: played from a draw, continued by another actor, driven by a person."""
