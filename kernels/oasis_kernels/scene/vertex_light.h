// The light that vertices receive, and what stays on them of a photo's shade: `avatar.vertex_light` in one text
// for the CPU and CUDA. V is a number, or 16 of them in a vector; `power` is defined before.
const float gamma = rules[0], deep_inside = rules[10], outside = rules[11];
const float turned_away = rules[12], facing_alike = rules[13], other_pose = rules[14], same_pose = rules[15];
const float same_sky = rules[16], other_sky = rules[17], same_beside = rules[18], other_beside = rules[19];
const float weak_shade = rules[20], deep_shade = rules[21];
const float *least_light = rules + 1, *in_hollows = rules + 4, *in_crevices = rules + 7;
// 0 at `from`, 1 at `to`, straight between them.
auto ramp = [&](V x, V from, V to) -> V { return smallest(largest((x - from) / (to - from), zero), one); };
auto faces_alike = [&](V3 n, V3 before) -> V { return ramp(dot3(n, before), (V)(turned_away), (V)(facing_alike)); };
auto more_sky = [&](V now, V before) -> V { return largest(now - before, zero); };
// Of red, green and blue.
auto received = [&](V3 n, int c) -> V {
    const float* h = harmonics + c;
    V total = h[0] + h[3] * n.x + h[6] * n.y + h[9] * n.z;
    if (n_harmonics > 4) {
        total += h[12] * n.x * n.y + h[15] * n.y * n.z + h[18] * (3.f * n.z * n.z - 1.f);
        total += h[21] * n.x * n.z + h[24] * (n.x * n.x - n.y * n.y);
    }
    return smallest(largest(total, (V)(limits[c])), (V)(limits[3 + c]));
};
// The share that arrives of it where the sky is seen so far, and that skin close by leaves.
auto arrives = [&](V sky, V hidden, int c) -> V {
    const float a = 2.0404f * albedo[c] - .3324f, b = .6417f - 4.7951f * albedo[c], d = 2.7552f * albedo[c] + .6903f;
    const V share = power(largest(sky, ((sky * a + b) * sky + d) * sky), in_hollows[c]);
    return (least_light[c] + (1.f - least_light[c]) * share) * (1.f - (1.f - in_crevices[c]) * hidden);
};
auto hidden_close = [&](V sky, V close) -> V { return close * ramp(sky, (V)(outside), (V)(deep_inside)); };
// Shares of deep and of weak shade that stay where the sky opens by `own`, and by `near` at most nearby.
auto under_sky = [&](V own, V near, V doubtful, V* deep, V* weak) {
    const V same = same_sky + (same_beside - same_sky) * doubtful;
    const V other = other_sky + (other_beside - other_sky) * doubtful;
    *deep = *deep * ramp(near, other, same);
    *weak = *weak * ramp(own + (near - own) * doubtful, other, same);
};
// The share of weak shade that stays where the light's own shade is `red`, `green` and `blue`: as of that, if it is
// deep.
auto beside_deep = [&](V deep, V weak, V red, V green, V blue) -> V {
    const V most = largest(largest(magnitude(red - 1.f), magnitude(green - 1.f)), magnitude(blue - 1.f));
    return weak + ramp(most, (V)(weak_shade), (V)(deep_shade)) * (smallest(weak, deep) - weak);
};
