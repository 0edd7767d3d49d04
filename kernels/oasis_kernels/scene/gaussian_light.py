"""The colours of Gaussians in light: `gaussian_light.cpp` and `gaussian_light.cu`."""

from oasis_kernels.runtime.cuda_native import cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

STATE = PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
BLOCK = 256
"""Threads of a block."""

light_gaussians = native("scene/gaussian_light.cpp", "light_gaussians")
light_gaussians_cuda = cuda_native("scene/gaussian_light.cu", "light_gaussians", BLOCK)
"""Kernel: a thread for each Gaussian of each image."""
