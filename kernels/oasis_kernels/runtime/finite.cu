// Whether numbers on a CUDA device are finite and of a sensible size: one launch for several arrays.
//
// A block looks at `CHUNK` numbers of one array; a bad one sets a word in the host's memory, which is
// read once the device has finished.

__global__ void all_finite(
    volatile long long* found,
    double largest,
    const void* arrays[ARRAYS],
    long long counts[ARRAYS],
    long long wide[ARRAYS]
) {
    const void* data = nullptr;
    long long count = 0, first = 0, chunk = block_index;
    int is_wide = 0;
#pragma unroll
    for (int k = 0; k < ARRAYS; k++)
        if (chunk >= 0) {
            const long long chunks = (counts[k] + CHUNK - 1) / CHUNK;
            if (chunk < chunks) {
                data = arrays[k];
                count = counts[k];
                is_wide = (int)wide[k];
                first = chunk * CHUNK;
            }
            chunk -= chunks;
        }
    const long long end = first + CHUNK < count ? first + CHUNK : count;
    bool bad = false;
    if (is_wide) {
        const double* const values = (const double*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -largest && values[i] <= largest);  // true for NaN too
    } else {
        const float* const values = (const float*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -(float)largest && values[i] <= (float)largest);
    }
    if (bad) *found = 1;
}
