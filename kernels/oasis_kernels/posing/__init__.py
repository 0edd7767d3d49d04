"""Gaussians on a posed mesh: face rotations, barycentric points, and everything fused."""
