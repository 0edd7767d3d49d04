struct Corner {
    double x, y, z;
};
struct Triangle {
    Corner a, b, c;
};
struct Ray {
    double u, v;
};  // passes (u, v, 1)
struct Weights {
    double a, b, c, sum;
};
struct Exact {
    static __device__ Corner in_camera(const Camera& camera, double x, double y, double z) {
        const double* r = camera.view;
        return {
            r[0] * x + r[1] * y + r[2] * z + r[3], r[4] * x + r[5] * y + r[6] * z + r[7],
            r[8] * x + r[9] * y + r[10] * z + r[11]
        };
    }
    static __device__ Corner corner(const Camera& camera, const float* p) {
        return in_camera(camera, p[0], p[1], p[2]);
    }
    static __device__ Triangle triangle(const Camera& camera, const float* mesh, const int* faces, int f) {
        const int i = faces[3ll * f], j = faces[3ll * f + 1], k = faces[3ll * f + 2];
        return {corner(camera, mesh + 3ll * i), corner(camera, mesh + 3ll * j), corner(camera, mesh + 3ll * k)};
    }
    static __device__ Ray ray(const Camera& camera, int x, int y) {
        return {camera.lens[2] + (double)x * camera.lens[3], camera.lens[6] + (double)y * camera.lens[7]};
    }
    // `depth_buffer.edge_functions`: barycentrics times their sum, all of one sign inside, edges included.
    static __device__ Weights weigh(const Triangle& t, Ray ray) {
        const double ax = t.a.x - ray.u * t.a.z, ay = t.a.y - ray.v * t.a.z;
        const double bx = t.b.x - ray.u * t.b.z, by = t.b.y - ray.v * t.b.z;
        const double cx = t.c.x - ray.u * t.c.z, cy = t.c.y - ray.v * t.c.z;
        const double wa = bx * cy - by * cx, wb = cx * ay - cy * ax, wc = ax * by - ay * bx;
        return {wa, wb, wc, wa + wb + wc};
    }
    static __device__ double depth(const Triangle& t, const Weights& w) {
        return (w.a * t.a.z + w.b * t.b.z + w.c * t.c.z) / w.sum;
    }
    // Out of line: where it is called rarely, its registers must not cost the rest.
    static __device__ __noinline__ double depth_of_face(
        const Camera& camera, const float* mesh, const int* faces, int f, Ray ray
    ) {
        const Triangle t = triangle(camera, mesh, faces, f);
        return depth(t, weigh(t, ray));
    }
};
