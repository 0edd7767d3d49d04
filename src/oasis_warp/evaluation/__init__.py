"""Evaluation of avatars: on synthetic hands with ground truth, and on other photos of the same hand."""
