const int width_bits = __builtin_ctzll(strip_width), height_bits = __builtin_ctzll(strip_height);
struct Span {
    int x0, y0, x1, y1;
};  // strips, past the end
auto span_of = [&](const int* box) -> Span {
    return {
        box[0] >> width_bits, box[1] >> height_bits, ((box[2] - 1) >> width_bits) + 1, ((box[3] - 1) >> height_bits) + 1
    };
};
// The strips of a span, one loop with one way out: most spans have one strip.
auto each_strip = [&](const Span& s, auto&& visit) {
    long long strip = (long long)s.y0 * across + s.x0;
    const int wide = s.x1 - s.x0, number = wide * (s.y1 - s.y0);
    for (int k = 0, x = 0; k < number; k++) {
        visit(strip);
        x++;
        strip += x == wide ? across - wide + 1 : 1;
        x = x == wide ? 0 : x;
    }
    return number;
};
auto is_drawn = [](const int* box) -> bool { return box[0] < box[2] && box[1] < box[3]; };
