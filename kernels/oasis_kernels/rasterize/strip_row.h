// Two rows of a layer, from y on: the parts of W d that their columns share, and the place of the first of these.
const V Y = row + (float)(p.top + y);
const V dy = (Y - l.whole_y) + l.ry;
const V u0 = fma((V)l.w1, dy, (V)(l.w0 * l.rx)), v0 = fma((V)l.w3, dy, (V)(l.w2 * l.rx));
V X = column + (float)(p.left + l.x0);
