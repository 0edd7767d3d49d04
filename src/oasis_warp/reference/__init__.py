"""The operators written out in plain torch, differentiated by torch: one implementation for two uses.

In float64 on small scenes they are the oracle of `certify`; in float32 on large ones they are the peer that `bench`
times the kernels against. They share no code and no constants with the kernels.
"""
