"""Launching: how kernel text becomes a CPU or CUDA function, and checks that every kernel shares."""
