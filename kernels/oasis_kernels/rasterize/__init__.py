"""Gaussians to pictures: projection, binning, blending, their adjoints, and spherical harmonics."""
