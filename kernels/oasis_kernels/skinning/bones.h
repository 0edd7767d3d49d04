typedef SCALAR T;
struct D3 {
    double x, y, z;
};
struct D33 {
    double m[3][3];
};
auto dot = [](D3 a, D3 b) -> double { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto times = [](const D33& a, const D33& b) -> D33 {
    D33 o;
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) o.m[r][c] = a.m[r][0] * b.m[0][c] + a.m[r][1] * b.m[1][c] + a.m[r][2] * b.m[2][c];
    return o;
};
auto apply = [](const D33& a, D3 v) -> D3 {
    auto row = [&](int r) -> double { return a.m[r][0] * v.x + a.m[r][1] * v.y + a.m[r][2] * v.z; };
    return {row(0), row(1), row(2)};
};
auto read3 = [](const T* p) -> D3 { return {(double)p[0], (double)p[1], (double)p[2]}; };
auto about = [&](D3 a, double angle) -> D33 {  // Rodrigues
    const double s = wp::sin(angle), k = 1.0 - wp::cos(angle), square = dot(a, a);
    return {
        {{1.0 + k * (a.x * a.x - square), k * a.x * a.y - s * a.z, k * a.x * a.z + s * a.y},
         {k * a.y * a.x + s * a.z, 1.0 + k * (a.y * a.y - square), k * a.y * a.z - s * a.x},
         {k * a.z * a.x - s * a.y, k * a.z * a.y + s * a.x, 1.0 + k * (a.z * a.z - square)}}
    };
};

#if defined(__CUDA_ARCH__)  // one block per pose, whose threads share the bones
#define EACH_BONE for (int j = threadIdx.x; j < n_joints; j += BLOCK)
#define EACH_ROW for (int r = threadIdx.x; r < 3; r += 3)
#define TOGETHER __syncthreads();
#else
#define EACH_BONE for (int j = 0; j < n_joints; j++)
#define EACH_ROW for (int r = 0; r < 3; r++)
#define TOGETHER
#endif
