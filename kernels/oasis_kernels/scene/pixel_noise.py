"""Normal random numbers for pixels, from a seed an image: the same whatever the batch, the device and the threads."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def normal(first: int, seeds: wp.array[wp.int32], n_each: int, out: wp.array2d[wp.float32]):
    i = first + wp.tid()
    b = i // n_each
    k = i - b * n_each
    state = wp.rand_init(seeds[b], k)
    out[b, k] = wp.randn(state)
