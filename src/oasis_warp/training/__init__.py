"""Fit an avatar to a photo."""
