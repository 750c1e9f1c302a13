"""Meshes: files read into metres, one texture, normals, symmetries."""
