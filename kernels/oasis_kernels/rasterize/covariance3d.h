// The covariance s in the world, F F^T with F = R S.
V f[9];
for (int e = 0; e < 9; e++) f[e] = r[e] * scale[e % 3];
int e = 0;
for (int row = 0; row < 3; row++)
    for (int other = row; other < 3; other++, e++)
        s[e] = f[3 * row] * f[3 * other] + f[3 * row + 1] * f[3 * other + 1] + f[3 * row + 2] * f[3 * other + 2];
