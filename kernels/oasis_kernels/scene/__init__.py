"""Kernels of the synthetic world only: rooms, skies, skin shading, surface patterns."""
