"""Losses that are computed at every step of a fit."""
