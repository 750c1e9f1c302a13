"""Training samples: pairs, crops and their streams."""
