"""Pictures for people: overlays, figures, recordings."""
