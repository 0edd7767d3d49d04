"""Cameras and drawing."""
