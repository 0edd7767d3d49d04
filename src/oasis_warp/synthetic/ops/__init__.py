"""Operators of the synthetic world only; they share the machinery of `oasis_warp.ops`."""
