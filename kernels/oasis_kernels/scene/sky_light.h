// The turn of an image's directions as a matrix, and the light from a turned direction, on the CPU and on CUDA. The
// harmonics are those of irradiance: a cosine lobe leaves 2/3 and 1/4 of the first and second degree.
auto matrix_of = [&](const float* q, float* m) {
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = 1.f - 2.f * (y * y + z * z), m[1] = 2.f * (x * y - w * z), m[2] = 2.f * (x * z + w * y);
    m[3] = 2.f * (x * y + w * z), m[4] = 1.f - 2.f * (x * x + z * z), m[5] = 2.f * (y * z - w * x);
    m[6] = 2.f * (x * z - w * y), m[7] = 2.f * (y * z + w * x), m[8] = 1.f - 2.f * (x * x + y * y);
};
auto light_from = [&](const float* m, const float* d, float sign, float* to) {
    const float x = sign * (m[0] * d[0] + m[1] * d[1] + m[2] * d[2]);
    const float y = sign * (m[3] * d[0] + m[4] * d[1] + m[5] * d[2]);
    const float z = sign * (m[6] * d[0] + m[7] * d[1] + m[8] * d[2]);
    const float second[5] = {x * y, y * z, 3.f * z * z - 1.f, x * z, x * x - y * y};
    for (int c = 0; c < 3; c++) {
        const float* h = harmonics + c;
        float sum = h[0] + 1.5f * (h[3] * x + h[6] * y + h[9] * z);
        for (int k = 4; k < n_harmonics; k++) sum += 4.f * h[3 * k] * second[k - 4];
        to[c] = sum > 0.f ? sum : 0.f;
    }
};
