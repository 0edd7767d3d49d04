// Three rows of the view; for columns and rows: focal length, centre, the first ray and the step between rays.
struct Camera {
    double view[12], lens[8];
};
// Thread t of 14 or more reads its part of the camera of batch entry b.
auto read_camera = [&](Camera& camera, int b, int t) {
    if (t < 12) camera.view[t] = viewmats[b * viewmats_step + t];
    if (t == 12 || t == 13) {
        const float* K = Ks + b * Ks_step;
        double* lens = camera.lens + 4 * (t - 12);
        lens[0] = K[4 * (t - 12)];
        lens[1] = K[2 + 3 * (t - 12)];
        lens[3] = 1.0 / lens[0];
        lens[2] = (0.5 - lens[1]) * lens[3];
    }
};
