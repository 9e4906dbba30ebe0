"""Drawings that explain results: each takes what a stage returned and returns an image."""
