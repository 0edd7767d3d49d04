// The colours of Gaussians in light on CUDA: a thread for each Gaussian of each image.

__global__ void light_gaussians(
#include "gaussian_light_parameters.inc"
) {
#include "../posing/vectors_cuda.h"
#include "gaussian_light.h"
    const long long at = (long long)block_index * BLOCK + threadIdx.x;
    if (at >= (long long)batch * n) return;
    const int b = (int)(at / n), i = (int)(at - (long long)b * n);
    const long long first = (long long)b * n_vertices;
    float read[5] = {0.f, 0.f, 0.f, 0.f, 0.f};
    for (int k = 0; k < 3; k++) {
        const float *row = columns + 5 * (first + corners[3 * i + k]), weight = weights[3 * i + k];
        for (int c = 0; c < 5; c++) read[c] += weight * row[c];
    }
    const float deep = read[3];
    float weak = read[4];
    if (folds && folds[i] >= 0) {
        const int m = folds[i];
        float seen, paint;
        open_fold(b, m, &seen, &paint);
        for (int c = 0; c < 3; c++) read[c] *= expf(fold_change[3 * m + c] * (seen + paint * (1.f - weak)));
        weak *= 1.f - seen;
    }
    if (shade) shaded(shade + 3ll * i, deep, weak, read);
    if (creases && creases[i] >= 0) {
        float share = 0.f;
        for (int k = 0; k < 3; k++) share += weights[3 * i + k] * stretched[first + corners[3 * i + k]];
        const float* logs = share > 0.f ? crease_change : wrinkles;
        for (int c = 0; c < 3; c++) read[c] *= expf(fabsf(share) * logs[3 * creases[i] + c]);
    }
    for (int c = 0; c < 3; c++) out[3 * at + c] = fminf(fmaxf(colors[3 * i + c] * read[c], 0.f), 1.f);
}
