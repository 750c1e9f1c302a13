"""Photographs, videos, cameras, masks and poses from and to files."""
