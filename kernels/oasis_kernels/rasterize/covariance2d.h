// The covariance in the image, M M^T + eps2d with M = B F, and its determinant.
V m0[3], m1[3];
for (int e = 0; e < 3; e++) {
    m0[e] = f[e] * b0[0] + f[3 + e] * b0[1] + f[6 + e] * b0[2];
    m1[e] = f[e] * b1[0] + f[3 + e] * b1[1] + f[6 + e] * b1[2];
}
const V flat_xx = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
const V flat_yy = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2];
xy = m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2];
xx = flat_xx + eps2d;
yy = flat_yy + eps2d;
// Cauchy-Binet: a sum of terms >= 0, where xx yy - xy^2 cancels for needles.
const V n0 = m0[1] * m1[2] - m0[2] * m1[1];
const V n1 = m0[2] * m1[0] - m0[0] * m1[2];
const V n2 = m0[0] * m1[1] - m0[1] * m1[0];
det = n0 * n0 + n1 * n1 + n2 * n2 + eps2d * (flat_xx + flat_yy + eps2d);
