// At x/z = u, y/z = v and `inverse` = 1/z: the slopes in J, clamped, its scales, and the rows of B = J R_camera.
slope_u = u < k.u_low ? (V)(k.u_low) : u > k.u_high ? (V)(k.u_high) : u;
slope_v = v < k.v_low ? (V)(k.v_low) : v > k.v_high ? (V)(k.v_high) : v;
j0 = k.fx * inverse;
j1 = k.fy * inverse;
for (int e = 0; e < 3; e++) {
    b0[e] = j0 * (k.r[e] - slope_u * k.r[6 + e]);
    b1[e] = j1 * (k.r[3 + e] - slope_v * k.r[6 + e]);
}
