typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
typedef bool M __attribute__((ext_vector_type(16)));
typedef float FU __attribute__((ext_vector_type(16), aligned(4)));
typedef int IU __attribute__((ext_vector_type(16), aligned(4)));
auto bits = [](I m) -> unsigned { return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, M)); };
// Columns c and c + 1 of a matrix of four columns, whose rows are the quarters of a and b: 8 numbers each.
#define COLUMNS(a, b, c)                                                                                            \
    __builtin_shufflevector(                                                                                        \
        a, b, c, c + 4, c + 8, c + 12, c + 16, c + 20, c + 24, c + 28, c + 1, c + 5, c + 9, c + 13, c + 17, c + 21, \
        c + 25, c + 29                                                                                              \
    )
// The eight numbers from place c of a, then of b.
#define HALVES(a, b, c)                                                                                           \
    __builtin_shufflevector(                                                                                      \
        a, b, c, c + 1, c + 2, c + 3, c + 4, c + 5, c + 6, c + 7, c + 16, c + 17, c + 18, c + 19, c + 20, c + 21, \
        c + 22, c + 23                                                                                            \
    )
const int quads = (height + 3) / 4, stride = 4 * ((width + SPARE_COLUMNS + 15) / 16 * 16);
const long long plane = (long long)quads * stride;
// Buffers of batch entry b: for each part the inverse depths of its pixels, 0 where nothing is, then their faces,
// unwritten where nothing is.
auto planes = [&](int b, int part) -> float* { return (float*)job.planes + 2 * plane * (b * job.parts + part); };
// Two inverse depths, each 2^-18 of itself off at the most, tell which is nearer if they are this far apart.
const float DOUBT = 1.52587890625e-5f;

struct Scene {
    View view;
    const double* camera;
};
auto corner = [&](const Scene& scene, int f, int j) -> Corner {
    const double* p = scene.camera + 4ll * faces[3ll * f + j];
    return {(D)(p[0]), (D)(p[1]), (D)(p[2])};
};
// |w.sum| up to here is a face seen edge-on: `depth_buffer.triangle`.
auto edge_on = [](const Corner& a, const Corner& b, const Corner& c) -> double {
    const double ex = b.x[0] - a.x[0], ey = b.y[0] - a.y[0], ez = b.z[0] - a.z[0];
    const double gx = c.x[0] - a.x[0], gy = c.y[0] - a.y[0], gz = c.z[0] - a.z[0];
    const double nx = ey * gz - ez * gy, ny = ez * gx - ex * gz, nz = ex * gy - ey * gx;
    return 1e-13 * __builtin_sqrt(nx * nx + ny * ny + nz * nz);
};
// Depths at which face `f` is hit in eight pixels from (x, y); 0 for a miss.
auto exact = [&](const Scene& scene, int f, int x, int y) __attribute__((noinline)) -> D {
    const Corner p = corner(scene, f, 0), q = corner(scene, f, 1), r = corner(scene, f, 2);
    const D u = scene.view.u0 + (eight + (double)x) * scene.view.du;
    const D v = (D)(scene.view.v0 + (double)y * scene.view.dv);
    const Weights w = weigh(p, q, r, u, v);
    const D z = depth_of(w, p.z, q.z, r.z);
    return (w.inside & (absolute(w.sum) > edge_on(p, q, r)) & (z > near_plane)) ? z : (D)(0.0);
};
// Enter face `f` at pixel (x, y), place i, which it hits at depth z; 1 / z is near `inverse`.
auto contest =
    [&](const Scene& scene, float* inverses, int* ids, long long i, int f, int x, int y, double z, float inverse) {
        const float apart = inverse - inverses[i], doubt = DOUBT * inverse;
        if (inverses[i] > 0.f && apart <= doubt) {
            if (apart < -doubt) return;
            const double rival = exact(scene, ids[i], x, y)[0];
            if (z > rival || (z == rival && f > ids[i])) return;
        }
        inverses[i] = inverse;
        ids[i] = f;
    };
