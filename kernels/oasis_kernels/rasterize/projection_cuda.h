// Full precision from approximations of 20 bits, by two steps of Newton's.
auto reciprocal = [](double x) -> double {
    double r;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
    r = fma(r, fma(-x, r, 1.0), r);
    return fma(r, fma(-x, r, 1.0), r);
};
auto inverse_root = [](double x) -> double {
    double r;
    asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
    r = fma(0.5 * r, fma(-x * r, r, 1.0), r);
    return fma(0.5 * r, fma(-x * r, r, 1.0), r);
};
struct Camera {
    double r[9], t[3], fx, fy, cx, cy, u_low, u_high, v_low, v_high;  // r by rows; limits of x/z and y/z in J
};
auto camera_at = [&](int c) -> Camera {
    const float *view = viewmats + 16 * (long long)c, *K = Ks + 9 * (long long)c;
    Camera out;
    for (int row = 0; row < 3; row++) {
        for (int column = 0; column < 3; column++) out.r[3 * row + column] = view[4 * row + column];
        out.t[row] = view[4 * row + 3];
    }
    out.fx = K[0];
    out.fy = K[4];
    out.cx = K[2];
    out.cy = K[5];
    const double per_fx = reciprocal(out.fx), per_fy = reciprocal(out.fy);
    const double margin_x = JACOBIAN_LIMIT * 0.5 * width * per_fx;
    const double margin_y = JACOBIAN_LIMIT * 0.5 * height * per_fy;
    out.u_low = -out.cx * per_fx - margin_x;
    out.u_high = (width - out.cx) * per_fx + margin_x;
    out.v_low = -out.cy * per_fy - margin_y;
    out.v_high = (height - out.cy) * per_fy + margin_y;
    if (ortho) out.u_low = out.u_high = out.v_low = out.v_high = 0.0;  // J has no slopes
    return out;
};
// Rotation matrix by rows of a quaternion of any norm but 0; 1 / |q|^2. Squares of float32 fit in float64.
auto rotation = [&](double w, double x, double y, double z, double* r) -> double {
    const double inverse = reciprocal(w * w + x * x + y * y + z * z), two = inverse + inverse;
    r[0] = 1.0 - two * (y * y + z * z);
    r[1] = two * (x * y - w * z);
    r[2] = two * (x * z + w * y);
    r[3] = two * (x * y + w * z);
    r[4] = 1.0 - two * (x * x + z * z);
    r[5] = two * (y * z - w * x);
    r[6] = two * (x * z - w * y);
    r[7] = two * (y * z + w * x);
    r[8] = 1.0 - two * (x * x + y * y);
    return inverse;
};
// Symmetric part: xx, xy, xz, yy, yz, zz.
auto load_covariance = [&](int i, double* s) {
    const float* p = covars + 9 * (long long)i;
    s[0] = p[0];
    s[1] = 0.5 * ((double)p[1] + (double)p[3]);
    s[2] = 0.5 * ((double)p[2] + (double)p[6]);
    s[3] = p[4];
    s[4] = 0.5 * ((double)p[5] + (double)p[7]);
    s[5] = p[8];
};
