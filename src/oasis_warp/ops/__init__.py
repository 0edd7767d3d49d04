"""Differentiable operators on torch tensors, computed by Warp kernels on the CPU or a CUDA device."""
