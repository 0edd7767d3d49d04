// How lanes agree on the nearest vertex. `together` has a bit for each lane of the warp that takes part.
typedef unsigned long long Key;  // squared distance, then place in the row
auto key_of = [](float squared, int place) -> Key { return (Key)__float_as_uint(squared) << 32 | (unsigned)place; };
auto squared_of = [](Key key) -> float { return __uint_as_float((unsigned)(key >> 32)); };
auto nearest_of = [](Key key, unsigned together, int lanes) -> Key {
    for (int step = lanes / 2; step > 0; step >>= 1) key = min(key, __shfl_xor_sync(together, key, step));
    return key;
};
