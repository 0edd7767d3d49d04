// Fingers and palm of a posed hand give way to each other where they touch (the operator contact_shifts).
"use strict";

const DEEPEST = 0.005, ASIDE = 0.003, PUSH = 0.00075, PAD = 0.003; // metres
const OPPOSED = -0.3, PARTS_OPPOSED = 0.3; // cosines of normals
const FADES = 0.5; // share of the skin around a vertex that touches, below which its shift fades
const ROUNDS = 6;
const BETWEEN = 0.0015, CREVICE = 0.0024; // metres: no gap along the skin, gap over which closeness falls to 1/e
const FREE = Math.PI / 18; // change of an angle from the photo's pose
const BOX = 15; // numbers a part: corners of its skin, corners of its skin with the flesh under it, normal

function makeContact({ data, faces, nVertices: n }) {
  const { contactMembers: members, contactStarts: starts, contactGive: give } = data.arrays, nParts = starts.length - 1;
  const part = new Uint16Array(n), rings = neighbours(faces, n);
  for (let p = 0; p < nParts; p++) for (let e = starts[p]; e < starts[p + 1]; e++) part[members[e]] = p;
  const beside = Array.from({ length: nParts }, () => new Set());
  for (let v = 0; v < n; v++) eachNear(rings, v, (j) => beside[part[v]].add(part[j]));
  const bits = data.arrays.contactAllowed, groups = bits.length / nParts, parts = [...Array(nParts).keys()];
  return {
    n, nParts, members, starts, give, part, rings, beside: beside.map((near) => [...near]),
    allowed: parts.map((p) => parts.filter((q) => (bits[groups * p + (q >> 5)] >>> (q & 31)) & 1)),
    samples: data.arrays.contactSamples, wide: secondNeighbours(rings, n), close: new Uint8Array(n),
    outward: data.side === "left" ? -1 : 1, boxes: new Float64Array(BOX * nParts), met: Array(nParts),
    reached: new Uint8Array(nParts), normals: new Float32Array(3 * n), others: new Int32Array(n),
    shifts: new Float32Array(3 * n), wanted: new Float32Array(4 * n), mean: new Float32Array(4 * n),
    closeness: new Float32Array(n), // of each vertex to other skin that it faces
  };
}

// Vertices joined to each vertex by an edge, itself first: entries start[v] to start[v + 1] of index.
function neighbours(faces, n) {
  const around = Array.from({ length: n }, (_, v) => new Set([v]));
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; k++) {
      around[faces[f + k]].add(faces[f + ((k + 1) % 3)]);
      around[faces[f + ((k + 1) % 3)]].add(faces[f + k]);
    }
  }
  return startsOf(around.map((own) => [...own]));
}

// The same of vertices at most two edges away, without those that are named twice.
function secondNeighbours(rings, n) {
  const around = Array.from({ length: n }, (_, v) => {
    const near = new Set();
    eachNear(rings, v, (j) => near.add(j));
    return [...near];
  });
  return startsOf(around);
}

function startsOf(around) {
  const start = new Uint32Array(around.length + 1);
  around.forEach((own, v) => (start[v + 1] = start[v] + own.length));
  return { start, index: Uint16Array.from(around.flat()) };
}

function eachNear({ start, index }, v, use) {
  for (let e = start[v]; e < start[v + 1]; e++) {
    for (let k = start[index[e]]; k < start[index[e] + 1]; k++) use(index[k]);
  }
}

// Move the vertices of body.posed out of each other; not at all in the photo's pose, and wholly from FREE away from it.
// How close to other skin that leaves them goes into contact.closeness.
function giveWay({ data, posed, faces, around, start, contact }, angles) {
  const bent = Math.max(...angles.map((angle, k) => Math.abs(angle - data.poses[0].angles[k])));
  contact.closeness.fill(0);
  if (bent === 0) return;
  boxParts(contact, posed, faces);
  if (!meetParts(contact)) return;
  const { n, part, reached, normals, shifts, mean } = contact, sum = [0, 0, 0];
  for (let v = 0; v < n; v++) {
    if (!reached[part[v]]) continue;
    sum.fill(0);
    for (let e = start[v]; e < start[v + 1]; e++) addArea(posed, faces, around[e], sum);
    const length = contact.outward * Math.sqrt(dot(sum, sum)) || 1;
    for (let d = 0; d < 3; d++) normals[3 * v + d] = sum[d] / length;
  }
  if (!findOthers(contact, posed)) return;
  shifts.fill(0);
  mean.fill(0);
  for (let k = 0; k < ROUNDS; k++) {
    leadOut(contact, posed);
    spreadShifts(contact);
  }
  const share = Math.min(bent / FREE, 1);
  for (let i = 0; i < posed.length; i++) shifts[i] *= share;
  findCloseness(contact, posed, share);
  for (let i = 0; i < posed.length; i++) posed[i] += shifts[i];
}

function addArea(points, faces, f, sum) {
  const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2];
  const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
  const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
  sum[0] += uy * vz - uz * vy;
  sum[1] += uz * vx - ux * vz;
  sum[2] += ux * vy - uy * vx;
}

const unit = (v, sign) => v.map((x) => (sign * x) / (Math.sqrt(dot(v, v)) || 1));

function boxParts({ nParts, members, starts, samples, outward, boxes }, points, faces) {
  for (let p = 0; p < nParts; p++) {
    const at = BOX * p, sum = [0, 0, 0], each = samples.length / nParts;
    for (let k = 0; k < each; k++) addArea(points, faces, samples[each * p + k], sum);
    const facing = unit(sum, outward);
    for (let d = 0; d < 3; d++) {
      let low = Infinity, high = -Infinity;
      for (let e = starts[p]; e < starts[p + 1]; e++) {
        const x = points[3 * members[e] + d];
        if (x < low) low = x;
        if (x > high) high = x;
      }
      boxes[at + d] = low;
      boxes[at + 3 + d] = high;
      boxes[at + 6 + d] = Math.min(low, low - DEEPEST * facing[d]) - PAD;
      boxes[at + 9 + d] = Math.max(high, high - DEEPEST * facing[d]) + PAD;
      boxes[at + 12 + d] = facing[d];
    }
  }
}

// Whether the boxes with low corners at a and b overlap.
function overlap(boxes, a, b) {
  return boxes[a] < boxes[b + 3] && boxes[b] < boxes[a + 3] && boxes[a + 1] < boxes[b + 4] && boxes[b + 1] < boxes[a + 4] &&
    boxes[a + 2] < boxes[b + 5] && boxes[b + 2] < boxes[a + 5];
}

// For each part those that have skin where it has flesh, or the other way round; whether there are any.
function meetParts({ nParts, allowed, boxes, met, beside, reached }) {
  let some = false;
  for (let p = 0; p < nParts; p++) {
    const at = BOX * p, found = [];
    for (const q of allowed[p]) {
      const to = BOX * q;
      if (!overlap(boxes, at, to + 6) && !overlap(boxes, at + 6, to)) continue;
      const x = boxes[at + 12] * boxes[to + 12] + boxes[at + 13] * boxes[to + 13] + boxes[at + 14] * boxes[to + 14];
      if (x < PARTS_OPPOSED) found.push(q);
    }
    met[p] = found;
    some ||= found.length > 0;
  }
  for (let p = 0; p < nParts; p++) reached[p] = beside[p].some((q) => met[q].length > 0);
  return some;
}

// For each vertex the nearest one of a part that it meets, which it faces; -1 for none. Whether there is one.
function findOthers({ n, part, met, boxes, members, starts, normals, others }, points) {
  let some = false;
  for (let v = 0; v < n; v++) {
    const x = points[3 * v], y = points[3 * v + 1], z = points[3 * v + 2];
    let nearest = DEEPEST * DEEPEST, other = -1;
    for (const p of met[part[v]]) {
      const b = BOX * p, dx = Math.max(boxes[b] - x, x - boxes[b + 3], 0), dy = Math.max(boxes[b + 1] - y, y - boxes[b + 4], 0);
      const dz = Math.max(boxes[b + 2] - z, z - boxes[b + 5], 0);
      if (dx * dx + dy * dy + dz * dz >= nearest) continue;
      for (let e = starts[p]; e < starts[p + 1]; e++) {
        const j = members[e], rx = points[3 * j] - x, ry = points[3 * j + 1] - y, rz = points[3 * j + 2] - z;
        const distance = rx * rx + ry * ry + rz * rz;
        if (distance < nearest && facing(normals, v, j) < OPPOSED) (nearest = distance), (other = j);
      }
    }
    others[v] = other;
    some ||= other >= 0;
  }
  return some;
}

const facing = (normals, i, j) =>
  normals[3 * i] * normals[3 * j] + normals[3 * i + 1] * normals[3 * j + 1] + normals[3 * i + 2] * normals[3 * j + 2];

// Of the last nearest vertex and those around it the one that is nearest to v now, and how deep v lies under it.
function nearestNow({ wide: { start, index }, normals, others, shifts }, points, v) {
  const last = others[v];
  const x = points[3 * v] + shifts[3 * v], y = points[3 * v + 1] + shifts[3 * v + 1], z = points[3 * v + 2] + shifts[3 * v + 2];
  let other = last, squared = Infinity;
  for (let e = start[last]; e < start[last + 1]; e++) {
    const j = index[e], rx = points[3 * j] + shifts[3 * j] - x, ry = points[3 * j + 1] + shifts[3 * j + 1] - y;
    const rz = points[3 * j + 2] + shifts[3 * j + 2] - z, distance = rx * rx + ry * ry + rz * rz;
    if (distance < squared && (j === last || facing(normals, v, j) < OPPOSED)) (squared = distance), (other = j);
  }
  const o = 3 * other, rx = points[o] + shifts[o] - x, ry = points[o + 1] + shifts[o + 1] - y;
  const depth = rx * normals[o] + ry * normals[o + 1] + (points[o + 2] + shifts[o + 2] - z) * normals[o + 2];
  return { other, squared, depth };
}

function findCloseness(contact, points, share) {
  const { n, others, closeness } = contact;
  for (let v = 0; v < n; v++) {
    if (others[v] < 0) continue;
    const { squared, depth } = nearestNow(contact, points, v);
    const past = Math.sqrt(Math.max(squared - depth * depth, 0)) - BETWEEN;
    closeness[v] = share * Math.exp(-(Math.max(-depth, 0) + Math.max(past, 0)) / CREVICE);
  }
}

// The shift that leads each vertex out of the skin nearest to it now, and 1 where there is one.
function leadOut(contact, points) {
  const { n, give, normals, others, wanted } = contact;
  wanted.fill(0);
  for (let v = 0; v < n; v++) {
    if (others[v] < 0) continue;
    const { other, squared, depth } = nearestNow(contact, points, v), o = 3 * other;
    const both = give[v] + give[other];
    if (depth <= -PUSH || squared - depth * depth >= ASIDE * ASIDE || both <= 0) continue;
    const length = ((depth + PUSH) * give[v]) / both;
    for (let k = 0; k < 3; k++) wanted[4 * v + k] = length * normals[o + k];
    wanted[4 * v + 3] = 1;
  }
}

// Add the mean of the shifts over two rings, and hold each vertex to what it can give.
function spreadShifts({ n, rings, wide, close, give, shifts, wanted, mean }) {
  const sum = [0, 0, 0, 0];
  markAround(rings, wanted, n, close);
  for (let v = 0; v < n; v++) {
    sum.fill(0);
    if (close[v]) meanAround(rings, wanted, v, sum);
    for (let k = 0; k < 4; k++) mean[4 * v + k] = sum[k];
  }
  markAround(wide, wanted, n, close);
  for (let v = 0; v < n; v++) {
    if (!close[v]) continue; // its mean is 0
    meanAround(rings, mean, v, sum);
    const share = Math.max(sum[3], FADES);
    const x = shifts[3 * v] + sum[0] / share, y = shifts[3 * v + 1] + sum[1] / share, z = shifts[3 * v + 2] + sum[2] / share;
    const length = Math.sqrt(x * x + y * y + z * z), scale = length > give[v] ? give[v] / length : 1;
    shifts[3 * v] = scale * x;
    shifts[3 * v + 1] = scale * y;
    shifts[3 * v + 2] = scale * z;
  }
}

// 1 for vertices with one around them that wants a shift.
function markAround({ start, index }, wanted, n, marks) {
  marks.fill(0);
  for (let v = 0; v < n; v++) {
    if (wanted[4 * v + 3]) for (let e = start[v]; e < start[v + 1]; e++) marks[index[e]] = 1;
  }
}

function meanAround({ start, index }, values, v, out) {
  let a = 0, b = 0, c = 0, d = 0;
  for (let e = start[v]; e < start[v + 1]; e++) {
    const at = 4 * index[e];
    a += values[at];
    b += values[at + 1];
    c += values[at + 2];
    d += values[at + 3];
  }
  const degree = start[v + 1] - start[v];
  out[0] = a / degree;
  out[1] = b / degree;
  out[2] = c / degree;
  out[3] = d / degree;
}
