struct Layer {
    float cx, cy, w0, w1, w2, w3, lo;
};
const unsigned all = 0xffffffffu;
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
const int4 own = tiles[block_index];  // column, start and length of the list, row over all cameras
const int start = own.y, count = own.z;
const int camera = n_cameras == 1 ? 0 : own.w / tiles_y;
const int left = own.x * 8, top = (own.w - camera * tiles_y) * 8;
// Those of this camera, by number over all cameras.
const float* const own_opacities = opacities + (long long)camera * (opacity_step - n);
const float* const own_colors = colors + (long long)camera * (color_step - n) * CHANNELS;
const long long first_pixel = ((long long)camera * height + top) * width + left;
// Segments of the list, of 32 layers or a multiple.
const int segment = max(32, ((count + SEGMENTS - 1) / SEGMENTS + 31) & ~31);
// The memory of what is kept of this tile: by boundary between segments, number and pixel.
float* const boundaries =
    checkpoints ? checkpoints + (long long)block_index * ((SEGMENTS - 1) * (CHANNELS + 1) * 64) : nullptr;
auto boundary = [&](int b, int k, int pixel) -> float& { return boundaries[(b * (CHANNELS + 1) + k) * 64 + pixel]; };
auto power = [](float x) -> float {
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
};
auto log2_of = [](float x) -> float {
    float r;
    asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
};
auto inverse = [](float x) -> float {
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
};

// Layers of a warp, STRIDE floats each: centre, W, log2 of the opacity, place in the list, colour.
__shared__ __align__(16) float layer_memory[WARPS][32 * STRIDE];
float* const layers = layer_memory[warp];
const unsigned layers_at = (unsigned)__cvta_generic_to_shared(layers);
auto load4 = [](unsigned at) -> float4 {  // of shared memory, without the arithmetic that a pointer costs
    float4 v;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];" : "=f"(v.x), "=f"(v.y), "=f"(v.z), "=f"(v.w) : "r"(at));
    return v;
};
auto put = [&](int slot, const Layer& l, int place, const float* color) {
    float* const to = layers + slot * STRIDE;
    *(float4*)to = {l.cx, l.cy, l.w0, l.w1};
    *(float4*)(to + 4) = {l.w2, l.w3, l.lo, __int_as_float(place)};
#pragma unroll
    for (int k = 0; k < PADDED; k += 4)
        *(float4*)(to + 8 + k) = {
            color[k], k + 1 < CHANNELS ? color[k + 1] : 0.f, k + 2 < CHANNELS ? color[k + 2] : 0.f,
            k + 3 < CHANNELS ? color[k + 3] : 0.f
        };
};
auto put_nothing = [&](int slot) {  // a layer that nobody sees
    float* const to = layers + slot * STRIDE;
    for (int k = 0; k < STRIDE; k++) to[k] = 0.f;
    to[6] = -1e9f;
};

// A Gaussian as the tile sees it: centre from the middle of the tile's first pixel, a small, exact number and a
// remainder; W scaled so that alpha = 2^(lo - |W d|^2).
auto layer = [&](const float4& c, const float4& w, float opacity) -> Layer {
    const float s = SCALE;
    return {
        (c.x - (float)left) + (c.z - 0.5f),
        (c.y - (float)top) + (c.w - 0.5f),
        w.x * s,
        w.y * s,
        w.z * s,
        w.w * s,
        log2_of(opacity)
    };
};
// Whether it can reach a pixel of the columns 0 .. 7 and the rows y_low .. y_high: the least |W d|^2 over the
// rectangle lies at its middle or on an edge that faces the centre. The slack is larger than what rounding does.
auto reaches = [&](const Layer& l, float y_low, float y_high) -> bool {
    const float cut = l.lo - CUT;
    const float x0 = -l.cx, x1 = 7.f - l.cx, y0 = y_low - l.cy, y1 = y_high - l.cy;
    const float dx = fminf(fmaxf(0.f, x0), x1), dy = fminf(fmaxf(0.f, y0), y1);
    auto fits = [&](float ex, float ey) -> bool {
        const float u = l.w0 * ex + l.w1 * ey, p = l.w2 * ex, q = l.w3 * ey;
        const float v = fmaxf(fabsf(p + q) - 1e-6f * (fabsf(p) + fabsf(q)), 0.f);
        return u * u + v * v <= cut;
    };
    const float xx = l.w0 * l.w0 + l.w2 * l.w2, yy = l.w1 * l.w1 + l.w3 * l.w3, xy = l.w0 * l.w1 + l.w2 * l.w3;
    bool any = dx == 0.f && dy == 0.f;
    if (dx != 0.f) any |= fits(dx, fminf(fmaxf(-xy * dx * inverse(yy), y0), y1));
    if (dy != 0.f) any |= fits(fminf(fmaxf(-xy * dy * inverse(xx), x0), x1), dy);
    return any && cut >= 0.f;
};
