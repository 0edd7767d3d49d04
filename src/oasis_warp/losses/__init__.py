"""Losses on pictures."""
