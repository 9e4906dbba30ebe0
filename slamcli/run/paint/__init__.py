"""Painting a map of frames that have their poses, and writing it."""
