// Posed Gaussians seen by a camera: ellipses in the picture, the farthest first. EWA splatting by the rules of gsplat,
// as in the operator `rasterization`.
"use strict";

const EPS2D = 0.3; // variance added to both axes of the picture [px^2]
const JACOBIAN_LIMIT = 0.3; // slopes are clamped to the picture and this share of half the field of view
const NEAR = 0.01; // [m]
const FACES_AWAY = -0.4; // cosine between normal and the way to the eye below which skin lies behind other skin
const STRIDE = 6; // words an ellipse: centre x, y; longer axis x, y; shorter over longer axis; colour and opacity
const DEPTHS = 65536; // bins of the sort

function makeProjection({ count }) {
  return {
    index: new Uint32Array(count), depths: new Float32Array(count),
    ellipses: new Float32Array(5 * count), keys: new Uint16Array(count), starts: new Uint32Array(DEPTHS + 1),
  };
}

// The camera that looks at `target` from `distance`, as oasis_warp.core.camera.orbit_camera; rows of the world to camera.
function orbitCamera({ azimuth, elevation, target, distance, fieldOfView, width, height }) {
  const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
  const rows = [[ca, 0, -sa], [sa * se, ce, ca * se], [sa * ce, -se, ca * ce]];
  const place = rows.map((row) => -row[0] * target[0] - row[1] * target[1] - row[2] * target[2]);
  place[2] += distance;
  const focal = Math.min(width, height) / 2 / Math.tan(fieldOfView / 2);
  return { rows, place, focal, width, height, eye: target.map((x, k) => x - rows[2][k] * distance) };
}

// Middle and radius of the sphere around the box of the surface: what orbit_camera frames.
function frameSurface(posed) {
  const { middle, radius } = ball(posed);
  return { target: middle, radius: radius / MARGIN };
}

// Ellipses that can be seen; the number of them.
function projectGaussians(gaussians, projection, camera) {
  const { means, covariances, heaviest, shown, count } = gaussians, { index, depths, ellipses } = projection;
  const { rows: [[a, b, c], [d, e, f], [g, h, k]], place, focal, width, height } = camera;
  const slopeX = ((1 + JACOBIAN_LIMIT) * width) / 2 / focal, slopeY = ((1 + JACOBIAN_LIMIT) * height) / 2 / focal;
  let n = 0;
  for (let i = 0; i < count; i++) {
    if (!shown[heaviest[i]]) continue;
    const mx = means[3 * i], my = means[3 * i + 1], mz = means[3 * i + 2];
    const z = g * mx + h * my + k * mz + place[2];
    if (z < NEAR) continue;
    const u = (a * mx + b * my + c * mz + place[0]) / z, v = (d * mx + e * my + f * mz + place[1]) / z;
    const x = focal * u + width / 2, y = focal * v + height / 2, scale = focal / z;
    const cu = Math.min(Math.max(u, -slopeX), slopeX), cv = Math.min(Math.max(v, -slopeY), slopeY);
    const p0 = scale * (a - g * cu), p1 = scale * (b - h * cu), p2 = scale * (c - k * cu);
    const q0 = scale * (d - g * cv), q1 = scale * (e - h * cv), q2 = scale * (f - k * cv);
    const s = 6 * i, xx = covariances[s], xy = covariances[s + 1], xz = covariances[s + 2];
    const yy = covariances[s + 3], yz = covariances[s + 4], zz = covariances[s + 5];
    const t0 = xx * p0 + xy * p1 + xz * p2, t1 = xy * p0 + yy * p1 + yz * p2, t2 = xz * p0 + yz * p1 + zz * p2;
    const A = p0 * t0 + p1 * t1 + p2 * t2 + EPS2D, B = q0 * t0 + q1 * t1 + q2 * t2;
    const C = q0 * (xx * q0 + xy * q1 + xz * q2) + q1 * (xy * q0 + yy * q1 + yz * q2) +
      q2 * (xz * q0 + yz * q1 + zz * q2) + EPS2D;
    const middle = (A + C) / 2, apart = Math.sqrt(((A - C) / 2) ** 2 + B * B);
    const long = middle + apart, short = Math.max(middle - apart, 1e-6), reach = 3.4 * Math.sqrt(long);
    if (x + reach < 0 || x - reach > width || y + reach < 0 || y - reach > height) continue;
    // The eigenvector of the longer axis, from the row of the matrix that does not cancel.
    let ax = A >= C ? long - C : B, ay = A >= C ? B : long - A;
    const length = Math.sqrt(ax * ax + ay * ay), root = Math.sqrt(long);
    if (length > 0) (ax *= root / length), (ay *= root / length);
    else (ax = root), (ay = 0);
    const o = 5 * n;
    ellipses[o] = x;
    ellipses[o + 1] = y;
    ellipses[o + 2] = ax;
    ellipses[o + 3] = ay;
    ellipses[o + 4] = Math.sqrt(short / long);
    depths[n] = z;
    index[n++] = i;
  }
  return n;
}

// Which vertices carry Gaussians that are drawn: all, or those whose skin faces the eye, or nearly. The
// others lie behind; they fill what little the front lets through.
function markShown({ posed, nVertices, data }, { shown }, normals, [ex, ey, ez], facing) {
  if (!facing) return shown.fill(1);
  for (let v = 0; v < nVertices; v++) {
    const x = ex - posed[3 * v], y = ey - posed[3 * v + 1], z = ez - posed[3 * v + 2];
    const along = x * normals[3 * v] + y * normals[3 * v + 1] + z * normals[3 * v + 2];
    shown[v] = along > FACES_AWAY * Math.sqrt(x * x + y * y + z * z) ? 1 : 0;
  }
  for (const v of data.arrays.rim) shown[v] = 1; // the cap over the wrist faces elsewhere
}

// The ellipses in the order in which they are drawn, the farthest first, packed for the graphics card.
function sortEllipses(projection, colors, n) {
  const { index, depths, ellipses, keys, starts } = projection;
  let near = Infinity, far = -Infinity;
  for (let i = 0; i < n; i++) {
    if (depths[i] < near) near = depths[i];
    if (depths[i] > far) far = depths[i];
  }
  starts.fill(0);
  const scale = (DEPTHS - 1) / (far - near || 1);
  for (let i = 0; i < n; i++) {
    keys[i] = (far - depths[i]) * scale;
    starts[keys[i] + 1]++;
  }
  for (let k = 0; k < DEPTHS; k++) starts[k + 1] += starts[k];
  const packed = new Float32Array(STRIDE * n), words = new Uint32Array(packed.buffer);
  for (let i = n - 1; i >= 0; i--) { // of equal depths the first lies in front
    const from = 5 * i, to = STRIDE * --starts[keys[i] + 1];
    for (let k = 0; k < 5; k++) packed[to + k] = ellipses[from + k];
    words[to + 5] = colors[index[i]];
  }
  return packed;
}
