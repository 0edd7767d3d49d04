// What a posed hand hides of the light around it from its own skin: the operator sky_exposure on the coarse mesh.
// All of it happens in axes that turn with the wrist, so that nothing changes when the whole hand moves.
"use strict";

const BUFFER = 64; // side of a depth buffer [px]
const MARGIN = 1.03; // radius that a buffer shows, in radii of the surface
const LIFT = 0.002; // off the surface from which points look, and length of the ramp from seen to hidden [m]
const STEEPEST = 3; // tangent up to which depth may differ by a texel's slope
const MIN_LIGHT = 1e-6;
const NEARBY = 2; // rings of coarse faces within which what hid the sky counts as having moved, as in avatar/sky.py
const HURRY = 4;
const LOBE = [1, 2 / 3, 2 / 3, 2 / 3, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 4]; // what a cosine lobe leaves of each harmonic

function makeSky(body) {
  const { skyVertices, skyFaces, skyWeights } = body.data.arrays, count = skyVertices.length;
  return {
    count, own: new Float64Array(3 * count), normals: new Float64Array(3 * count), screen: new Float64Array(3 * count),
    depth: new Float32Array(BUFFER * BUFFER), whole: new Float64Array(4 * count), seen: new Float64Array(4 * count),
    shares: new Float32Array(skyWeights.length * count), turn: 0, smooth: new Float32Array(4 * count), touching: countCorners(skyFaces, count),
    exposure: new Float32Array(4 * body.nVertices),
  };
}

function countCorners(faces, count) {
  const out = new Uint16Array(count);
  for (const v of faces) out[v]++;
  return out;
}

// Shares of an even sky, then of the red, green and blue of the light that reach each vertex, into sky.exposure. In a
// hurry only every HURRY-th direction is looked from, and the others are as they were up to HURRY - 1 poses before.
function exposeVertices(body, sky, normals, harmonics, hurry) {
  const { skyVertices, skyFaces, skyDirections, skyAxes, skyWeights } = body.data.arrays, { count, own } = sky;
  const frame = rotationMatrix(body.quats, 4 * body.data.still);
  intoFrame(frame, body.posed, skyVertices, own);
  intoFrame(frame, normals, skyVertices, sky.normals);
  const { middle, radius } = ball(own);
  sky.turn = (sky.turn + 1) % HURRY;
  sky.whole.fill(0);
  sky.seen.fill(0);
  for (let k = 0; k < skyWeights.length; k++) {
    const toSky = skyDirections.subarray(3 * k, 3 * k + 3), axes = skyAxes.subarray(9 * k, 9 * k + 9);
    const shares = sky.shares.subarray(k * sky.count, (k + 1) * sky.count);
    if (!hurry || k % HURRY === sky.turn) {
      drawDepth(sky, axes, middle, radius, skyFaces);
      findShares(sky, toSky, axes, middle, radius, shares);
    }
    gather(sky, toSky, shares, skyWeights[k], radiance(harmonics, turned(frame, toSky)));
  }
  for (let i = 0; i < 4 * count; i++) sky.seen[i] = sky.whole[i] > MIN_LIGHT ? Math.min(sky.seen[i] / sky.whole[i], 1) : 1;
  smoothOverFaces(sky, skyFaces);
  readAtVertices(body, sky);
}

function rotationMatrix(quats, at) {
  const w = quats[at], x = quats[at + 1], y = quats[at + 2], z = quats[at + 3];
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
    2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

const turned = (m, p) => [0, 3, 6].map((r) => m[r] * p[0] + m[r + 1] * p[1] + m[r + 2] * p[2]);

function intoFrame(m, points, index, out) {
  for (let i = 0; i < index.length; i++) {
    const x = points[3 * index[i]], y = points[3 * index[i] + 1], z = points[3 * index[i] + 2];
    out[3 * i] = m[0] * x + m[3] * y + m[6] * z;
    out[3 * i + 1] = m[1] * x + m[4] * y + m[7] * z;
    out[3 * i + 2] = m[2] * x + m[5] * y + m[8] * z;
  }
}

function ball(points) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i++) {
    low[i % 3] = Math.min(low[i % 3], points[i]);
    high[i % 3] = Math.max(high[i % 3], points[i]);
  }
  const middle = low.map((x, k) => (x + high[k]) / 2);
  let most = 0;
  for (let i = 0; i < points.length; i += 3) {
    most = Math.max(most, (points[i] - middle[0]) ** 2 + (points[i + 1] - middle[1]) ** 2 + (points[i + 2] - middle[2]) ** 2);
  }
  return { middle, radius: MARGIN * Math.sqrt(most) };
}

function radiance(harmonics, d) {
  const basis = harmonicBasis(d[0], d[1], d[2]);
  return [0, 1, 2].map((c) => {
    let sum = 0;
    for (let k = 0; k < 9; k++) sum += (basis[k] * harmonics[3 * k + c]) / LOBE[k];
    return Math.max(sum, 0);
  });
}

const harmonicBasis = (x, y, z) => [1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y];

// The nearest surface at the centre of each pixel, as parallel rays from that way see it.
function drawDepth(sky, axes, middle, radius, faces) {
  const { own, screen, depth, count } = sky, scale = BUFFER / (2 * radius);
  for (let i = 0; i < count; i++) {
    const x = own[3 * i] - middle[0], y = own[3 * i + 1] - middle[1], z = own[3 * i + 2] - middle[2];
    screen[3 * i] = scale * (axes[0] * x + axes[1] * y + axes[2] * z) + BUFFER / 2 - 0.5;
    screen[3 * i + 1] = scale * (axes[3] * x + axes[4] * y + axes[5] * z) + BUFFER / 2 - 0.5;
    screen[3 * i + 2] = axes[6] * x + axes[7] * y + axes[8] * z;
  }
  depth.fill(Infinity);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ax = screen[a], ay = screen[a + 1], bx = screen[b], by = screen[b + 1], cx = screen[c], cy = screen[c + 1];
    const left = Math.ceil(Math.min(ax, bx, cx)), right = Math.floor(Math.max(ax, bx, cx));
    const top = Math.ceil(Math.min(ay, by, cy)), bottom = Math.floor(Math.max(ay, by, cy));
    if (left > right || top > bottom) continue;
    const doubled = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if (doubled === 0) continue;
    const za = screen[a + 2], zb = (screen[b + 2] - za) / doubled, zc = (screen[c + 2] - za) / doubled;
    const sign = doubled > 0 ? 1 : -1, limit = doubled * sign;
    for (let y = top; y <= bottom; y++) {
      for (let x = left; x <= right; x++) {
        const toB = (x - ax) * (cy - ay) - (y - ay) * (cx - ax), toC = (y - ay) * (bx - ax) - (x - ax) * (by - ay);
        if (toB * sign < 0 || toC * sign < 0 || (toB + toC) * sign > limit) continue;
        const z = za + toB * zb + toC * zc, at = BUFFER * y + x;
        if (z < depth[at]) depth[at] = z;
      }
    }
  }
}

// How much of one direction each vertex sees: percentage-closer filtered, four texels, each with a ramp.
function findShares(sky, toSky, axes, middle, radius, shares) {
  const { own, normals, depth, count } = sky, texel = (2 * radius) / BUFFER, scale = 1 / texel;
  for (let i = 0; i < count; i++) {
    const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
    const cosine = nx * toSky[0] + ny * toSky[1] + nz * toSky[2];
    if (cosine <= 0) continue;
    const px = own[3 * i] + LIFT * nx - middle[0], py = own[3 * i + 1] + LIFT * ny - middle[1];
    const pz = own[3 * i + 2] + LIFT * nz - middle[2];
    const x = scale * (axes[0] * px + axes[1] * py + axes[2] * pz) + BUFFER / 2 - 0.5;
    const y = scale * (axes[3] * px + axes[4] * py + axes[5] * pz) + BUFFER / 2 - 0.5;
    const far = axes[6] * px + axes[7] * py + axes[8] * pz;
    const steep = Math.min(Math.sqrt(Math.max(1 - cosine * cosine, 0)) / cosine, STEEPEST);
    const limit = LIFT + steep * texel - far, left = Math.floor(x), top = Math.floor(y), u = x - left, v = y - top;
    let share = 0;
    for (let corner = 0; corner < 4; corner++) {
      const column = Math.min(Math.max(left + (corner & 1), 0), BUFFER - 1);
      const row = Math.min(Math.max(top + (corner >> 1), 0), BUFFER - 1);
      const part = (corner & 1 ? u : 1 - u) * (corner >> 1 ? v : 1 - v);
      share += part * Math.min(Math.max((depth[BUFFER * row + column] + limit) / LIFT + 1, 0), 1);
    }
    shares[i] = share;
  }
}

// Add what arrives from one direction.
function gather({ normals, whole, seen, count }, toSky, shares, weight, [red, green, blue]) {
  for (let i = 0; i < count; i++) {
    const cosine = normals[3 * i] * toSky[0] + normals[3 * i + 1] * toSky[1] + normals[3 * i + 2] * toSky[2];
    if (cosine <= 0) continue;
    const arriving = weight * cosine, through = arriving * shares[i];
    whole[4 * i] += arriving;
    whole[4 * i + 1] += arriving * red;
    whole[4 * i + 2] += arriving * green;
    whole[4 * i + 3] += arriving * blue;
    seen[4 * i] += through;
    seen[4 * i + 1] += through * red;
    seen[4 * i + 2] += through * green;
    seen[4 * i + 3] += through * blue;
  }
}

// Means over the corners of the faces around each vertex.
function smoothOverFaces(sky, faces) {
  const { seen, smooth, touching, count } = sky;
  smooth.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 4; k++) {
      const sum = seen[4 * faces[f] + k] + seen[4 * faces[f + 1] + k] + seen[4 * faces[f + 2] + k];
      for (let c = 0; c < 3; c++) smooth[4 * faces[f + c] + k] += sum;
    }
  }
  for (let i = 0; i < count; i++) {
    for (let k = 4 * i; k < 4 * i + 4; k++) smooth[k] = touching[i] ? smooth[k] / (3 * touching[i]) : seen[k];
  }
}

// The largest of values, none below 0, over NEARBY rings of coarse faces around each vertex, into out.
function largestNearby(body, { count }, values, out) {
  const { skyVertices, skyFaces, skyCorners, skyShares } = body.data.arrays;
  let on = Float32Array.from(skyVertices, (v) => values[v]);
  for (let ring = 0; ring < NEARBY; ring++) {
    const next = new Float32Array(count);
    for (let f = 0; f < skyFaces.length; f += 3) {
      const a = skyFaces[f], b = skyFaces[f + 1], c = skyFaces[f + 2], most = Math.max(on[a], on[b], on[c]);
      next[a] = Math.max(next[a], most);
      next[b] = Math.max(next[b], most);
      next[c] = Math.max(next[c], most);
    }
    on = next;
  }
  for (let v = 0; v < body.nVertices; v++) {
    out[v] = 0;
    for (let c = 3 * v; c < 3 * v + 3; c++) out[v] += skyShares[c] * on[skyCorners[c]];
  }
}

function readAtVertices(body, sky) {
  const { skyCorners, skyShares } = body.data.arrays, { smooth, exposure } = sky;
  for (let v = 0; v < body.nVertices; v++) {
    for (let k = 0; k < 4; k++) {
      let sum = 0;
      for (let c = 3 * v; c < 3 * v + 3; c++) sum += skyShares[c] * smooth[4 * skyCorners[c] + k];
      exposure[4 * v + k] = sum;
    }
  }
}
