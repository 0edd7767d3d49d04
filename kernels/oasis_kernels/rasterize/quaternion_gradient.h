// By the quaternion w, x, y, z of any norm, of sum(h * R).
const V ax = h[7] - h[5], ay = h[2] - h[6], az = h[3] - h[1];
const V sx = h[5] + h[7], sy = h[2] + h[6], sz = h[1] + h[3];
const V g_w = x * ax + y * ay + z * az;
const V g_x = w * ax + y * sz + z * sy - 2.0 * x * (h[4] + h[8]);
const V g_y = w * ay + x * sz + z * sx - 2.0 * y * (h[0] + h[8]);
const V g_z = w * az + x * sy + y * sx - 2.0 * z * (h[0] + h[4]);
const V along = inverse_norm * (g_w * w + g_x * x + g_y * y + g_z * z), two = inverse_norm * 2.0;
const V g_quat[4] = {
    two * (g_w - along * w), two * (g_x - along * x), two * (g_y - along * y), two * (g_z - along * z)
};
