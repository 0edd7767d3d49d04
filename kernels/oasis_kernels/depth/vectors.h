typedef SCALAR T;
// Arguments of all kernels. Pointers are addresses; sizes of what they point to in brackets.
struct Job {
    long long vertices;        // T [batch or 1][n_vertices][3]
    long long viewmats;        // T [batch or 1][4][4]
    long long Ks;              // T [batch or 1][3][3]
    long long faces;           // int [n_faces][3]
    long long points;          // T [batch or 1][n_points][3]
    long long point_vertices;  // int [n_points], or 0
    long long vertices_step;   // numbers from one batch entry to the next, 0 where they share
    long long viewmats_step;
    long long Ks_step;
    long long points_step;
    long long camera_vertices;  // double [batch][n_vertices][4]: camera axes, and a spare number
    long long screen_vertices;  // int [batch][n_vertices][4]: x, y in fixed point, 1 / z, marks
    long long planes;           // [batch][parts]: float, then int, of `plane_size(width, height)`
    long long depth;            // T [batch][height][width]
    long long face_ids;         // int [batch][height][width]
    long long barycentrics;     // T [batch][height][width][3], or 0
    long long visibility;       // T [batch][n_points]
    long long slopes;           // T [batch][n_points], or 0
    long long pixels;           // int [batch][n_points], or 0
    long long grad_visibility;  // T [batch][n_points]
    long long sums;             // double [batch][n_vertices][3]
    long long grad_vertices;    // T [batch][n_vertices][3]
    int batch;
    int n_vertices;
    int n_faces;
    int n_points;
    int width;
    int height;
    int parts;  // of the faces, each drawn apart
    int fraction_bits;
    int identity;        // whether point_vertices counts
    int next_transform;  // counters of tasks
    int next_draw;
    int next_write;
    int next_score;
    int next_pull;
    int found;  // not 0: there may be values that are refused
    double near_plane;
    double tau;
    double margin;
};
Job& job = *(Job*)address;

typedef double D __attribute__((ext_vector_type(8)));
typedef decltype(D{} < D{}) L;
typedef double D4 __attribute__((ext_vector_type(4)));
typedef T T8 __attribute__((ext_vector_type(8)));
typedef bool M8 __attribute__((ext_vector_type(8)));
// Rows in memory have the alignment of their numbers.
typedef double D4U __attribute__((ext_vector_type(4), aligned(8)));
typedef T T8U __attribute__((ext_vector_type(8), aligned(sizeof(T))));
auto bits8 = [](L m) -> int { return __builtin_bit_cast(unsigned char, __builtin_convertvector(m, M8)); };
const D eight = {0, 1, 2, 3, 4, 5, 6, 7};

const int width = job.width, height = job.height;
const int* faces = (const int*)job.faces;
const double near_plane = job.near_plane;

struct View {
    double r[12];  // world to camera: three rows
    double fx, fy, cx, cy;
    double u0, v0, du, dv;  // the ray of pixel (x, y) passes (u0 + x du, v0 + y dv, 1)
    int bad;
};
auto view_of = [&](int b) -> View {
    View view;
    const T* m = (const T*)job.viewmats + b * job.viewmats_step;
    const T* K = (const T*)job.Ks + b * job.Ks_step;
    view.bad = 0;
    for (int i = 0; i < 16; i++)
        if (!(m[i] <= (T)1e15 && m[i] >= (T)-1e15)) view.bad = 1;
    for (int i = 0; i < 9; i++)
        if (!(K[i] <= (T)1e15 && K[i] >= (T)-1e15)) view.bad = 1;
    if (!(K[0] > 0) || !(K[4] > 0)) view.bad = 1;
    for (int i = 0; i < 12; i++) view.r[i] = m[i];
    view.fx = K[0];
    view.fy = K[4];
    view.cx = K[2];
    view.cy = K[5];
    view.du = 1.0 / view.fx;
    view.dv = 1.0 / view.fy;
    view.u0 = (0.5 - view.cx) * view.du;
    view.v0 = (0.5 - view.cy) * view.dv;
    return view;
};
// Eight rows of three numbers, of which `n` exist; the last one stands in for the others.
auto load3 = [](const T* p, int n, D& x, D& y, D& z) {
    T spare[24];
    if (n < 8) {
        for (int i = 0; i < 24; i++) spare[i] = p[i < 3 * n ? i : 3 * (n - 1) + i % 3];
        p = spare;
    }
    const D a = __builtin_convertvector((T8) * (const T8U*)p, D);
    const D b = __builtin_convertvector((T8) * (const T8U*)(p + 8), D);
    const D c = __builtin_convertvector((T8) * (const T8U*)(p + 16), D);
    x = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, -1, -1), c, 0, 1, 2, 3, 4, 5, 10, 13);
    y = __builtin_shufflevector(
        __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, -1, -1, -1), c, 0, 1, 2, 3, 4, 8, 11, 14
    );
    z = __builtin_shufflevector(
        __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, -1, -1, -1), c, 0, 1, 2, 3, 4, 9, 12, 15
    );
};
auto in_camera = [](const View& v, int k, D x, D y, D z) -> D {
    return v.r[4 * k] * x + v.r[4 * k + 1] * y + v.r[4 * k + 2] * z + v.r[4 * k + 3];
};
auto absolute = [](D v) -> D { return __builtin_elementwise_abs(v); };

// `depth_buffer.barycentrics` for eight pairs of a triangle and a ray.
struct Corner {
    D x, y, z;
};
struct Weights {
    D a, b, c, sum;
    L inside;
};
auto weigh = [](const Corner& a, const Corner& b, const Corner& c, D u, D v) -> Weights {
    const D ax = a.x - u * a.z, ay = a.y - v * a.z;
    const D bx = b.x - u * b.z, by = b.y - v * b.z;
    const D cx = c.x - u * c.z, cy = c.y - v * c.z;
    Weights w;
    w.a = bx * cy - by * cx;
    w.b = cx * ay - cy * ax;
    w.c = ax * by - ay * bx;
    w.inside = ((w.a >= 0.0) & (w.b >= 0.0) & (w.c >= 0.0)) | ((w.a <= 0.0) & (w.b <= 0.0) & (w.c <= 0.0));
    w.sum = w.a + w.b + w.c;
    return w;
};
auto depth_of = [](const Weights& w, D az, D bz, D cz) -> D { return (w.a * az + w.b * bz + w.c * cz) / w.sum; };
// Corner j of eight faces.
auto gather = [&](const double* camera, const int* ids, int j) -> Corner {
    D4 r[8];
    for (int k = 0; k < 8; k++) r[k] = *(const D4U*)(camera + 4ll * faces[3ll * ids[k] + j]);
    const D r01 = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
    const D r23 = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
    const D r45 = __builtin_shufflevector(r[4], r[5], 0, 1, 2, 3, 4, 5, 6, 7);
    const D r67 = __builtin_shufflevector(r[6], r[7], 0, 1, 2, 3, 4, 5, 6, 7);
    const D low = __builtin_shufflevector(r01, r23, 0, 4, 8, 12, 1, 5, 9, 13);
    const D high = __builtin_shufflevector(r45, r67, 0, 4, 8, 12, 1, 5, 9, 13);
    const D low_z = __builtin_shufflevector(r01, r23, 2, 6, 10, 14, -1, -1, -1, -1);
    const D high_z = __builtin_shufflevector(r45, r67, 2, 6, 10, 14, -1, -1, -1, -1);
    return {
        __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11),
        __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15),
        __builtin_shufflevector(low_z, high_z, 0, 1, 2, 3, 8, 9, 10, 11)
    };
};
