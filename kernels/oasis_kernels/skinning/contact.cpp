// Contact of a posed surface with itself on the CPU: where skin lies inside other skin, and by how much both give way.
//
// Parts are patches of the surface of some millimetres, 32 a group; a word of bits says which parts of a group.
//
// Phases: the boxes of a part's skin, and of its skin with the flesh under it; those of groups; which parts meet, as
// they have skin where the other has flesh; normals of what is reached, in the order of the parts; the nearest skin
// that a vertex faces in those parts. Then in rounds, the same again among neighbours of the last one and the shift
// that leads out of it; and the mean of the shifts around. At last, how near to that skin this leaves each vertex.
// Normals are those before contact.

void resolve_contact(
    int batch,
    int n,
    int n_parts,
    int n_groups,
    int n_samples,
    int n_beside,
    int mirrored,          // faces wind the other way
    const float* lengths,  // of the constants below
    const float* points,   // [B, V, 3]
    const int* faces,      // [F, 3]
    const int* face_offsets,
    const int* face_entries,  // 3 face + corner, those of a vertex together
    const int* members,       // [V]: vertices by part
    const int* starts,        // [P + 1]
    const int* samples,       // [P, E]: some faces of each part
    const int* beside,        // [P, A]: parts next to each part, itself first; -1 fills rows up
    const int* allowed,       // [P, G]: bits of the parts that it may touch
    const float* give,        // [V]: how far each vertex can give way
    const int* offsets,       // [V + 1]
    const int* neighbours,
    const float* weights,     // of neighbours
    const float* part_of_it,  // [B]: of shifts and closeness that is wanted, or 0: all
    float* tables,            // [B, 4, V, 4], scratch: points, normals, shifts, wishes
    float* sorted,            // [B, 6, V + 16], scratch: points and normals in the order of the parts
    float* boxes,             // [B, P + G, 16], scratch: corners of skin, of skin with flesh; normal
    int* met,                 // [B, P, G], scratch
    int* meets,               // [B, P], scratch: 1 where a part meets another
    int* others,              // [B, V], scratch: the nearest skin, -1 for none
    int* moving,              // [B, V], scratch of zeros: 1 where a vertex near by has another
    float* shifts,            // [B, V, 3]
    float* close,             // [B, V]: exp(-gap / width); 0 where a vertex has no other
    long long* state  // `FLAGS` words of zeros; then 1 where any part meets another, and where any vertex has a wish
) {
#include "../posing/vectors.h"
#include "../runtime/ranges.h"
    const float reach = lengths[0], pad = lengths[1], parts_opposed = lengths[2], opposed = lengths[3];
    const float aside = lengths[4], margin = lengths[5], fades = lengths[6], between = lengths[7], width = lengths[8];
    const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    long long *any_met = state + PHASES * PHASE_WORDS, *any_wish = any_met + 1;
    auto lower = [](Q a, Q b) -> Q { return a < b ? a : b; };
    auto upper = [](Q a, Q b) -> Q { return a > b ? a : b; };
    auto dot = [](Q a, Q b) -> float {
        const Q p = a * b;
        return p[0] + p[1] + p[2];
    };
    auto table = [&](long long b, int k) -> float* { return tables + 4ll * n * (4 * b + k); };
    auto point = [&](const float* from) -> Q { return {from[0], from[1], from[2], 0.f}; };
    auto area_vector = [&](const float* x, int f) -> Q {
        const Q a = load_row(x + 4 * faces[3 * f]);
        const Q u = load_row(x + 4 * faces[3 * f + 1]) - a, v = load_row(x + 4 * faces[3 * f + 2]) - a;
        return {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0], 0.f};
    };
    auto unit = [&](Q a) -> Q {
        const float length = __builtin_sqrtf(dot(a, a));
        return a * (length > 0.f ? (mirrored ? -1.f : 1.f) / length : 0.f);
    };
    int phases = 0;
    // task(b, i) for the i-th of so many items of each surface, `size` of them at a time.
    auto each = [&](int items, int size, auto&& task) {
        const long long all = (long long)batch * items;
        phase(state + PHASE_WORDS * phases++, (all + size - 1) / size, [&](long long t) {
            for (long long i = t * size; i < wp::min(all, (t + 1) * size); i++) task(i / items, (int)(i % items));
        });
    };

    each(n, TASK, [&](long long b, int v) { store_row(table(b, 0) + 4 * v, point(points + 3 * (b * n + v))); });

    each(n_parts, 16, [&](long long b, int p) {
        const float* x = table(b, 0);
        float* to = sorted + b * 6 * (n + 16);
        Q low = load_row(x + 4 * members[starts[p]]), high = low, total = (Q)(0.f);
        for (int e = starts[p]; e < starts[p + 1]; e++) {
            const Q y = load_row(x + 4 * members[e]);
            low = lower(low, y), high = upper(high, y);
            for (int k = 0; k < 3; k++) to[k * (n + 16) + e] = y[k];
        }
        for (int k = 0; k < n_samples; k++) total += area_vector(x, samples[p * n_samples + k]);
        const Q facing = unit(total), under = low - reach * facing, over = high - reach * facing;
        float* box = boxes + 16 * (b * (n_parts + n_groups) + p);
        const Q flesh_low = lower(low, under) - pad, flesh_high = upper(high, over) + pad;
        for (int k = 0; k < 3; k++) {
            box[k] = low[k], box[3 + k] = high[k], box[6 + k] = flesh_low[k], box[9 + k] = flesh_high[k];
            box[12 + k] = facing[k];
        }
    });

    auto box_of = [&](long long b, int p) -> float* { return boxes + 16 * (b * (n_parts + n_groups) + p); };
    each(n_groups, 1, [&](long long b, int g) {
        float* box = box_of(b, n_parts + g);
        for (int k = 0; k < 6; k++) box[k] = box_of(b, 32 * g)[6 + k];
        for (int p = 32 * g + 1; p < wp::min(32 * g + 32, n_parts); p++)
            for (int k = 0; k < 3; k++) {
                box[k] = wp::min(box[k], box_of(b, p)[6 + k]);
                box[3 + k] = wp::max(box[3 + k], box_of(b, p)[9 + k]);
            }
    });

    auto overlap = [](const float* a, const float* b) -> bool {
        return (a[0] < b[3]) & (a[1] < b[4]) & (a[2] < b[5]) & (a[3] > b[0]) & (a[4] > b[1]) & (a[5] > b[2]);
    };
    each(n_parts, 8, [&](long long b, int p) {
        const float* own = box_of(b, p);
        bool any = false;
        for (int g = 0; g < n_groups; g++) {
            unsigned found = 0;
            if (allowed[p * n_groups + g] && overlap(own + 6, box_of(b, n_parts + g)))
                for (unsigned left = allowed[p * n_groups + g]; left; left &= left - 1) {
                    const int k = __builtin_ctz(left);
                    const float* other = box_of(b, 32 * g + k);
                    if (own[12] * other[12] + own[13] * other[13] + own[14] * other[14] < parts_opposed &&
                        (overlap(own, other + 6) || overlap(other, own + 6)))
                        found |= 1u << k;
                }
            met[(b * n_parts + p) * n_groups + g] = (int)found;
            any |= found != 0;
        }
        meets[b * n_parts + p] = any;
        if (any) __atomic_store_n(any_met, 1, __ATOMIC_RELAXED);
    });
    if (!__atomic_load_n(any_met, __ATOMIC_RELAXED)) return;

    auto reached = [&](long long b, int p) -> bool {
        for (int k = 0; k < n_beside; k++) {
            const int q = beside[p * n_beside + k];
            if (q >= 0 && meets[b * n_parts + q]) return true;
        }
        return false;
    };
    each(n_parts, 16, [&](long long b, int p) {
        const bool here = reached(b, p);
        const float* x = table(b, 0);
        float *normals = table(b, 1), *moved = table(b, 2), *to = sorted + (b * 6 + 3) * (n + 16);
        for (int i = starts[p]; i < starts[p + 1]; i++) {
            const int v = members[i];
            Q total = (Q)(0.f);
            for (int e = face_offsets[v]; here && e < face_offsets[v + 1]; e++)
                total += area_vector(x, face_entries[e] / 3);
            const Q normal = unit(total);
            store_row(normals + 4 * v, normal);
            store_row(moved + 4 * v, (Q)(0.f));
            for (int k = 0; k < 3; k++) to[k * (n + 16) + i] = normal[k];
        }
    });

    each(n_parts, 4, [&](long long b, int p) {
        const float *x = table(b, 0), *facing = table(b, 1), *s = sorted + b * 6 * (n + 16);
        for (int i = starts[p]; i < starts[p + 1]; i++) {
            const int v = members[i];
            const Q here = load_row(x + 4 * v), normal = load_row(facing + 4 * v);
            float nearest = reach * reach;
            int other = -1;
            auto look = [&](int q) {
                const float* box = box_of(b, q);
                float past = 0.f;
                for (int k = 0; k < 3; k++) {
                    const float off = wp::max(wp::max(box[k] - here[k], here[k] - box[3 + k]), 0.f);
                    past += off * off;
                }
                if (past >= nearest) return;
                for (int e = starts[q]; e < starts[q + 1]; e += 16) {
                    V distance = zero, cosine = zero;
                    for (int k = 0; k < 3; k++) {
                        const V way = load(s + k * (n + 16) + e) - here[k];
                        distance += way * way;
                        cosine += load(s + (3 + k) * (n + 16) + e) * normal[k];
                    }
                    const I fits = (lane < starts[q + 1] - e) & (distance < nearest) & (cosine < opposed);
                    if (!__builtin_reduce_or(fits)) continue;
                    distance = fits ? distance : (V)(1e30f);
                    nearest = __builtin_reduce_min(distance);
                    other = members[e + __builtin_reduce_min(distance == nearest ? lane : (I)(16))];
                }
            };
            for (int g = 0; g < n_groups; g++)
                for (unsigned left = met[(b * n_parts + p) * n_groups + g]; left; left &= left - 1)
                    look(32 * g + __builtin_ctz(left));
            others[b * n + v] = other;
            if (other >= 0)
                for (int e = offsets[v]; e < offsets[v + 1]; e++)
                    __atomic_store_n(moving + b * n + neighbours[e], 1, __ATOMIC_RELAXED);
        }
    });

    // Of the last nearest and its neighbours the vertex nearest to v that v faces, after both have moved.
    auto nearest_now = [&](long long b, int v, int last, const float* moved, Q* way) -> int {
        const float *x = table(b, 0), *facing = table(b, 1);
        auto place = [&](int j) -> Q { return load_row(x + 4 * j) + load_row(moved + 4 * j); };
        const Q here = place(v), normal = load_row(facing + 4 * v);
        int other = last;
        *way = place(last) - here;
        float least = dot(*way, *way);
        for (int e = offsets[last]; e < offsets[last + 1]; e++) {
            const int j = neighbours[e];
            const Q r = place(j) - here;
            const float distance = dot(r, r);
            if (distance < least && dot(normal, load_row(facing + 4 * j)) < opposed)
                other = j, least = distance, *way = r;
        }
        return other;
    };
    for (int round = 0; round < ROUNDS; round++) {
        each(n, TASK / 4, [&](long long b, int v) {
            const int last = others[b * n + v];
            Q wish = (Q)(0.f);
            if (last >= 0) {
                Q way;
                const int other = nearest_now(b, v, last, table(b, 2), &way);
                const Q m = load_row(table(b, 1) + 4 * other);
                const float depth = dot(way, m), both = give[v] + give[other];
                if (depth > -margin && dot(way, way) - depth * depth < aside * aside && both > 0.f) {
                    wish = m * ((depth + margin) * give[v] / both);
                    wish[3] = 1.f;
                    if (!round) __atomic_store_n(any_wish, 1, __ATOMIC_RELAXED);
                }
            }
            store_row(table(b, 3) + 4 * v, wish);
        });
        if (!__atomic_load_n(any_wish, __ATOMIC_RELAXED)) return;
        each(n, TASK / 4, [&](long long b, int v) {
            if (!moving[b * n + v]) return;
            const float* wishes = table(b, 3);
            Q total = (Q)(0.f);
            for (int e = offsets[v]; e < offsets[v + 1]; e++)
                total += weights[e] * load_row(wishes + 4 * neighbours[e]);
            const float most = wp::max(total[3], fades);
            total[3] = 0.f;
            Q moved = load_row(table(b, 2) + 4 * v) + total / most;
            const float length = __builtin_sqrtf(dot(moved, moved));
            if (length > give[v]) moved *= give[v] / length;
            store_row(table(b, 2) + 4 * v, moved);
        });
    }

    each(n, TASK, [&](long long b, int v) {
        const Q moved = load_row(table(b, 2) + 4 * v) * (part_of_it ? part_of_it[b] : 1.f);
        for (int k = 0; k < 3; k++) shifts[3 * (b * n + v) + k] = moved[k];
        store_row(table(b, 3) + 4 * v, moved);
    });
    each(n, TASK / 4, [&](long long b, int v) {
        const int last = others[b * n + v];
        float found = 0.f;
        if (last >= 0) {
            Q way;
            const int other = nearest_now(b, v, last, table(b, 3), &way);
            const float depth = dot(way, load_row(table(b, 1) + 4 * other));
            const float past = __builtin_sqrtf(wp::max(dot(way, way) - depth * depth, 0.f)) - between;
            found = wp::exp(-(wp::max(-depth, 0.f) + wp::max(past, 0.f)) / width) * (part_of_it ? part_of_it[b] : 1.f);
        }
        close[b * n + v] = found;
    });
}
