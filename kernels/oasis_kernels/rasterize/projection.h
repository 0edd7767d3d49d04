// What projection and its adjoint share, one text for the CPU and CUDA: V is a double, or eight of them in a vector, I
// what a comparison of such gives, a bool or a mask. `reciprocal` and `quotient` come from the prelude.
struct Camera {
    double r[9], t[3], fx, fy, cx, cy, u_low, u_high, v_low, v_high;  // r by rows; limits of x/z and y/z in J
};
auto camera_at = [&](long long c) -> Camera {
    const float *view = viewmats + 16 * c, *K = Ks + 9 * c;
    Camera out;
    for (int row = 0; row < 3; row++) {
        for (int column = 0; column < 3; column++) out.r[3 * row + column] = view[4 * row + column];
        out.t[row] = view[4 * row + 3];
    }
    out.fx = K[0];
    out.fy = K[4];
    out.cx = K[2];
    out.cy = K[5];
    const double margin_x = quotient(JACOBIAN_LIMIT * 0.5 * width, out.fx);
    const double margin_y = quotient(JACOBIAN_LIMIT * 0.5 * height, out.fy);
    out.u_low = -quotient(out.cx, out.fx) - margin_x;
    out.u_high = quotient(width - out.cx, out.fx) + margin_x;
    out.v_low = -quotient(out.cy, out.fy) - margin_y;
    out.v_high = quotient(height - out.cy, out.fy) + margin_y;
    if (ortho) out.u_low = out.u_high = out.v_low = out.v_high = 0.0;  // J has no slopes
    return out;
};
// Rotation matrix by rows of a quaternion of any norm but 0; 1 / |q|^2. Squares of float32 fit in float64.
auto rotation = [&](V w, V x, V y, V z, V* r) -> V {
    const V inverse = reciprocal(w * w + x * x + y * y + z * z), two = inverse + inverse;
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
