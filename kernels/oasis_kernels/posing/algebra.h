// Vectors and quaternions, one text for the CPU and CUDA: V is a number, or 16 of them in a vector, I what a comparison
// of such gives, a bool or a mask.
auto dot3 = [](V3 a, V3 b) -> V { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto dot4 = [](V4 a, V4 b) -> V { return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](V3 a, V3 b) -> V3 { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; };
auto scaled = [](V s, V3 a) -> V3 { return {s * a.x, s * a.y, s * a.z}; };
auto scaled4 = [](V s, V4 a) -> V4 { return {s * a.w, s * a.x, s * a.y, s * a.z}; };
auto plus = [](V3 a, V3 b) -> V3 { return {a.x + b.x, a.y + b.y, a.z + b.z}; };
auto minus = [](V3 a, V3 b) -> V3 { return {a.x - b.x, a.y - b.y, a.z - b.z}; };
auto plus4 = [](V4 a, V4 b) -> V4 { return {a.w + b.w, a.x + b.x, a.y + b.y, a.z + b.z}; };
auto choose = [](I mask, V3 a, V3 b) -> V3 { return {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z}; };
auto choose4 = [](I m, V4 a, V4 b) -> V4 { return {m ? a.w : b.w, m ? a.x : b.x, m ? a.y : b.y, m ? a.z : b.z}; };
