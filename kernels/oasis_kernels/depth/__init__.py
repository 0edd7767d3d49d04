"""Depth buffers of meshes, and which points they hide."""
