"""Following an object through a video."""
