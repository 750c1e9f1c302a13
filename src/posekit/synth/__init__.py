"""Synthetic data sets in BOP layout: domain-randomised, photorealistic, scenes and sequences."""
