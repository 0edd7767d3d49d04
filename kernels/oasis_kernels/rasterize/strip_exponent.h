// A vector of these rows: W d, and log2(alpha) before the cap.
const V d = X - l.whole_x;
const V u = fma((V)l.w0, d, u0), v = fma((V)l.w2, d, v0);
const V e = fma(-v, v, fma(-u, u, (V)l.lo));
