// Whether float32 numbers on the CPU are finite and of a sensible size: one pass, on one thread, for many arrays.

void all_finite(const long long* arrays, long long count, long long* found) {
    typedef float V __attribute__((ext_vector_type(16)));
    typedef float VU __attribute__((ext_vector_type(16), aligned(4)));
    for (long long a = 0; a < count; a++) {
        const float* values = (const float*)arrays[2 * a];
        const long long n = arrays[2 * a + 1];
        const float limit = 1e15f;
        decltype(V{} <= V{}) sound = V{} <= V{};
        long long i = 0;
        for (; i + 16 <= n; i += 16) {
            const V v = *(const VU*)(values + i);
            sound &= (v <= limit) & (v >= -limit);  // both false for NaN
        }
        bool bad = !__builtin_reduce_and(sound);
        for (; i < n; i++) bad |= !(values[i] <= limit && values[i] >= -limit);
        if (bad) *found = 1;
    }
}
