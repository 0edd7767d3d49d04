// The blended transforms of the points from i to i + 3, of which `count` are there.
const int count = wp::min(4, end - i);
const T* w[4];
V blends[4];
for (int k = 0; k < 4; k++) {
    w[k] = weights + (long long)wp::min(i + k, end - 1) * n_joints;
    blends[k] = (V)(0);
}
for (int j = 0; j < n_joints; j++) {
    const V transform = load(columns + 16 * j);
    for (int k = 0; k < 4; k++) blends[k] += w[k][j] * transform;
}
