// Point k of the four: the columns of its blended transform, its mean and its covariance.
const long long at = i + k;
const Q g0 = blends[k].lo.lo, g1 = blends[k].lo.hi, g2 = blends[k].hi.lo;
const T *x = means + 3 * at, *s = covars + 9 * at;
