// The colours of Gaussians in the light of the vertices around them: `avatar.pose.lit_in_steps` in one text for the CPU
// and CUDA. V is a number, or 16 of them in a vector.
// Shares of both kinds of shade leave so much of the Gaussian's own.
auto shaded = [&](const V* own, V deep, V weak, V* color) {
    const V beyond[3] = {own[0] - 1.f, own[1] - 1.f, own[2] - 1.f};
    const V most = largest(magnitude(beyond[0]), largest(magnitude(beyond[1]), magnitude(beyond[2])));
    const V share = smallest(largest((most - bounds[0]) * (1.f / (bounds[1] - bounds[0])), zero), one);
    const V stays = weak + (deep - weak) * share;
    for (int c = 0; c < 3; c++) color[c] *= 1.f + stays * beyond[c];
};
// How far the fold in row m opens, of what the photo shows and of what is painted.
auto open_fold = [&](int b, int m, float* seen, float* painting) {
    const float *first = opened + 2ll * (b * n_joints + joints[2 * m]), t = between[m], paint = painted[m];
    const float* second = opened + 2ll * (b * n_joints + joints[2 * m + 1]);
    *seen = (first[0] + (second[0] - first[0]) * t) * (1.f - paint);
    *painting = (first[1] + (second[1] - first[1]) * t) * paint;
};
