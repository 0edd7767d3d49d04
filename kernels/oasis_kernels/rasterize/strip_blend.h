// A vector of a layer in front of which the transmittance at `t` is left: what it covers, and where it ends a pixel.
#include "strip_exponent.h"
const V before = load(t);
const I drawn = (e >= cut()) & (before > 0.f) INSIDE;
const V raw = exp2(e);
const V alpha = drawn ? (raw < cap() ? raw : cap()) : (V)(0.f);
const V full = alpha * before;
const V after = before - full;
const I ends = drawn & (after <= last());
