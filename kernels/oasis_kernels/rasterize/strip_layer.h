// One Gaussian over one strip: `strip_row.h` and `strip_exponent.h` compute it at the pixels of its box.
struct Layer {
    int x0, y0, x1, y1;  // relative to the strip, y0 even
    float whole_x, whole_y, w0, w1, w2, w3, rx, ry, lo;
};
struct Strip {
    int left, top, columns, rows;
    long long stride;  // floats of two rows of one plane
};
auto strip_of = [&](long long s) -> Strip {
    const long long in_camera = s % (across * down);
    Strip p;
    p.left = (int)(in_camera % across) * (int)strip_width;
    p.top = (int)(in_camera / across) * (int)strip_height;
    p.columns = (int)(strip_width < width - p.left ? strip_width : width - p.left);
    p.rows = (int)(strip_height < height - p.top ? strip_height : height - p.top);
    p.stride = 2 * (strip_width + PAD);
    return p;
};
auto layer_of = [](const float* r, const Strip& p) -> Layer {
    const int* box = (const int*)r + 12;
    Layer l;
    l.x0 = box[0] > p.left ? box[0] - p.left : 0;
    l.y0 = (box[1] > p.top ? box[1] - p.top : 0) & ~1;
    l.x1 = box[2] - p.left < p.columns ? box[2] - p.left : p.columns;
    l.y1 = box[3] - p.top < p.rows ? box[3] - p.top : p.rows;
    l.whole_x = r[0];
    l.whole_y = r[1];
    l.rx = r[2];
    l.ry = r[3];
    l.w0 = r[4];
    l.w1 = r[5];
    l.w2 = r[6];
    l.w3 = r[7];
    l.lo = r[8];
    return l;
};
