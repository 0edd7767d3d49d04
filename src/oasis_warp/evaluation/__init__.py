"""Measure what avatars are worth: on synthetic hands where all is known, and on other photos of the same hand."""
