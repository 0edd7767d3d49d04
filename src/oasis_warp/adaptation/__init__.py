"""Fitting an avatar to photos of one hand."""
