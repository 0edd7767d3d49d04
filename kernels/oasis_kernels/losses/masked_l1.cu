// The mean absolute difference of two images of three channels inside a mask, and its gradient by the first.
//
// `sum_differences` (one block for every `CHUNK` pixels) writes the block's sums over pixels of mask |image - target|,
// all channels together, and of the mask, in float64. `mean_difference` (one block) adds them up, always in the same
// order, and divides: 1 / (3 max(sum of the mask, 1)) stays behind them for `spread_difference`, one thread a pixel.

__global__ void sum_differences(
    long long n,          // pixels
    const float* image,   // [n, 3]
    const float* target,  // [n, 3]
    const float* mask,    // [n]
    double* sums          // [blocks, 2]
) {
    __shared__ double of_threads[2][BLOCK];
    double difference = 0.0, cover = 0.0;
    for (int k = threadIdx.x; k < CHUNK; k += BLOCK) {
        const long long p = (long long)block_index * CHUNK + k;
        if (p >= n) break;
        const float *a = image + 3 * p, *b = target + 3 * p, weight = mask[p];
        for (int c = 0; c < 3; c++) difference += (double)(fabsf(a[c] - b[c]) * weight);
        cover += (double)weight;
    }
    of_threads[0][threadIdx.x] = difference;
    of_threads[1][threadIdx.x] = cover;
    for (int half = BLOCK / 2; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half)
            for (int k = 0; k < 2; k++) of_threads[k][threadIdx.x] += of_threads[k][threadIdx.x + half];
    }
    if (threadIdx.x == 0)
        for (int k = 0; k < 2; k++) sums[2ll * block_index + k] = of_threads[k][0];
}

__global__ void mean_difference(
    int n_sums,
    double* sums,  // [n_sums, 2], then room for one number
    float* mean    // [1]
) {
    __shared__ double of_threads[2][BLOCK];
    for (int k = 0; k < 2; k++) {
        double total = 0.0;
        for (int block = threadIdx.x; block < n_sums; block += BLOCK) total += sums[2 * block + k];
        of_threads[k][threadIdx.x] = total;
    }
    for (int half = BLOCK / 2; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half)
            for (int k = 0; k < 2; k++) of_threads[k][threadIdx.x] += of_threads[k][threadIdx.x + half];
    }
    if (threadIdx.x == 0) {
        const double cover = of_threads[1][0], share = 1.0 / (3.0 * (cover < 1.0 ? 1.0 : cover));
        mean[0] = (float)(of_threads[0][0] * share);
        sums[2 * n_sums] = share;
    }
}

__global__ void spread_difference(
    long long n,
    const float* image,   // [n, 3]
    const float* target,  // [n, 3]
    const float* mask,    // [n]
    const double* share,  // [1]
    const float* g_mean,  // [1]
    float* g_image        // [n, 3]
) {
    const long long p = (long long)block_index * BLOCK + threadIdx.x;
    if (p >= n) return;
    const float slope = (float)((double)g_mean[0] * share[0]) * mask[p];
    for (int c = 0; c < 3; c++) {
        const float difference = image[3 * p + c] - target[3 * p + c];
        g_image[3 * p + c] = difference > 0.f ? slope : difference < 0.f ? -slope : difference * slope;
    }
}
