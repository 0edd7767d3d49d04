// Tiles x0, y0, x1, y1 (past the end) that a box of pixels touches; empty boxes touch none.
auto tile_box = [](int4 box) -> int4 {
    if (box.x >= box.z || box.y >= box.w) return {0, 0, 0, 0};
    return {box.x >> 3, box.y >> 3, ((box.z - 1) >> 3) + 1, ((box.w - 1) >> 3) + 1};
};
