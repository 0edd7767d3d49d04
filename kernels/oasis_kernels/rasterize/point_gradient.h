// By B, g_b0 and g_b1, from the rows of G B; then by u, v and 1/z.
auto spread = [&](V* g) {
    const V g0 = g[0] + g[0], g1 = g[1] + g[1], g2 = g[2] + g[2];
    g[0] = s[0] * g0 + s[1] * g1 + s[2] * g2;
    g[1] = s[1] * g0 + s[3] * g1 + s[4] * g2;
    g[2] = s[2] * g0 + s[4] * g1 + s[5] * g2;
};
spread(g_b0);
spread(g_b1);
// J depends on the point by 1/z and its slopes, which stand still where they were clamped.
const V g_j00 = k.r[0] * g_b0[0] + k.r[1] * g_b0[1] + k.r[2] * g_b0[2];
const V g_j02 = k.r[6] * g_b0[0] + k.r[7] * g_b0[1] + k.r[8] * g_b0[2];
const V g_j11 = k.r[3] * g_b1[0] + k.r[4] * g_b1[1] + k.r[5] * g_b1[2];
const V g_j12 = k.r[6] * g_b1[0] + k.r[7] * g_b1[1] + k.r[8] * g_b1[2];
const V g_u = k.fx * g_x - ((slope_u == u) & moving ? j0 * g_j02 : (V)(0.0));
const V g_v = k.fy * g_y - ((slope_v == v) & moving ? j1 * g_j12 : (V)(0.0));
const V g_inverse = k.fx * (g_j00 - slope_u * g_j02) + k.fy * (g_j11 - slope_v * g_j12);
