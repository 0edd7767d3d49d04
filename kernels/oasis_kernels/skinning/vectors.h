typedef SCALAR T;
typedef T V __attribute__((ext_vector_type(16)));
typedef T VU __attribute__((ext_vector_type(16), aligned(sizeof(T))));
typedef T Q __attribute__((ext_vector_type(4)));
auto load = [](const T* p) -> V { return *(const VU*)p; };
auto store = [](T* p, V v) { *(VU*)p = v; };
auto store3 = [](T* p, Q v) { memcpy(p, &v, 3 * sizeof(T)); };
auto dot = [](Q a, Q b) -> T { return (a.x * b.x + a.y * b.y) + (a.z * b.z + a.w * b.w); };
