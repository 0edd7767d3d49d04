// How every face and vertex of the surface has turned and grown from rest (the operator face_rotations).
"use strict";

const PLANE = 14; // numbers a face at rest: axes t, b, n; length of e1; e2 along t and b; area; longest edge squared

function restPlanes({ rest, faces, nFaces }) {
  const planes = new Float64Array(PLANE * nFaces);
  for (let f = 0; f < nFaces; f++) {
    const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2];
    const e1 = [rest[b] - rest[a], rest[b + 1] - rest[a + 1], rest[b + 2] - rest[a + 2]];
    const e2 = [rest[c] - rest[a], rest[c + 1] - rest[a + 1], rest[c + 2] - rest[a + 2]];
    const e3 = [e2[0] - e1[0], e2[1] - e1[1], e2[2] - e1[2]], n = cross(e1, e2), twice = Math.sqrt(dot(n, n));
    const longest = Math.max(dot(e1, e1), dot(e2, e2), dot(e3, e3));
    const area = twice > FLAT * longest ? twice / 2 : 0; // 0 marks a flat face
    const length = Math.sqrt(dot(e1, e1)) || 1, t = [e1[0] / length, e1[1] / length, e1[2] / length];
    const normal = [n[0] / (twice || 1), n[1] / (twice || 1), n[2] / (twice || 1)], across = cross(normal, t);
    planes.set(t, PLANE * f);
    planes.set(across, PLANE * f + 3);
    planes.set(normal, PLANE * f + 6);
    planes.set([length, dot(e2, t), dot(e2, across), area, longest], PLANE * f + 9);
  }
  return planes;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// The faces at each vertex, the largest at rest first: it decides the signs of the others.
function facesAround({ faces, planes, nFaces, nVertices }) {
  const start = new Uint32Array(nVertices + 1), around = new Uint32Array(3 * nFaces);
  for (const v of faces) start[v + 1]++;
  for (let v = 0; v < nVertices; v++) start[v + 1] += start[v];
  const next = start.slice();
  for (let f = 0; f < nFaces; f++) for (let k = 0; k < 3; k++) around[next[faces[3 * f + k]]++] = f;
  let largest = 0;
  for (let f = 0; f < nFaces; f++) if (planes[PLANE * f + 12] > planes[PLANE * largest + 12]) largest = f;
  for (let v = 0; v < nVertices; v++) {
    let best = start[v];
    for (let e = best; e < start[v + 1]; e++) if (planes[PLANE * around[e] + 12] > planes[PLANE * around[best] + 12]) best = e;
    if (start[v + 1] > start[v]) [around[start[v]], around[best]] = [around[best], around[start[v]]];
  }
  return { start, around, largest };
}

function rotateFaces(body) {
  const { posed, faces, planes, nFaces, faceQuats, faceAreas, faceGrowth, faceWeights } = body;
  for (let f = 0; f < nFaces; f++) {
    const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2], p = PLANE * f;
    const ux = posed[b] - posed[a], uy = posed[b + 1] - posed[a + 1], uz = posed[b + 2] - posed[a + 2];
    const vx = posed[c] - posed[a], vy = posed[c + 1] - posed[a + 1], vz = posed[c + 2] - posed[a + 2];
    let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    const twice = Math.sqrt(nx * nx + ny * ny + nz * nz), u2 = ux * ux + uy * uy + uz * uz;
    const longest = Math.max(u2, vx * vx + vy * vy + vz * vz, (ux - vx) ** 2 + (uy - vy) ** 2 + (uz - vz) ** 2);
    const proper = twice > FLAT * longest, rest = planes[p + 12], damping = DAMPING * planes[p + 13];
    const before = rest + damping, after = (proper ? twice / 2 : 0) + damping;
    faceAreas[2 * f] = before;
    faceAreas[2 * f + 1] = after;
    faceGrowth[f] = before > 0 ? after / before : 1;
    faceWeights[f] = proper ? rest : 0;
    if (!proper || rest === 0) continue;
    nx /= twice, ny /= twice, nz /= twice;
    const length = Math.sqrt(u2), tx = ux / length, ty = uy / length, tz = uz / length;
    const bx = ny * tz - nz * ty, by = nz * tx - nx * tz, bz = nx * ty - ny * tx;
    const x = vx * tx + vy * ty + vz * tz, y = vx * bx + vy * by + vz * bz;
    // The polar factor of the map of the edges, in the plane.
    let cos = length * planes[p + 11] + planes[p + 9] * y, sin = length * planes[p + 10] - planes[p + 9] * x;
    const norm = Math.sqrt(cos * cos + sin * sin);
    cos /= norm, sin /= norm;
    quaternionOf(
      cos * tx + sin * bx, cos * ty + sin * by, cos * tz + sin * bz,
      cos * bx - sin * tx, cos * by - sin * ty, cos * bz - sin * tz, nx, ny, nz, planes, p, faceQuats, 4 * f,
    );
  }
  const usual = faceWeights[body.largest] > 0 ? faceQuats.slice(4 * body.largest, 4 * body.largest + 4) : [1, 0, 0, 0];
  for (let f = 0; f < nFaces; f++) if (faceWeights[f] === 0) faceQuats.set(usual, 4 * f);
  body.usual = usual;
}

// The rotation that takes the axes t, b, n at planes[p] to the given ones, w >= 0 (Shepperd 1978).
function quaternionOf(tx, ty, tz, bx, by, bz, nx, ny, nz, planes, p, out, at) {
  const a = planes[p], b = planes[p + 1], c = planes[p + 2], d = planes[p + 3], e = planes[p + 4], f = planes[p + 5];
  const g = planes[p + 6], h = planes[p + 7], i = planes[p + 8];
  const xx = tx * a + bx * d + nx * g, xy = tx * b + bx * e + nx * h, xz = tx * c + bx * f + nx * i;
  const yx = ty * a + by * d + ny * g, yy = ty * b + by * e + ny * h, yz = ty * c + by * f + ny * i;
  const zx = tz * a + bz * d + nz * g, zy = tz * b + bz * e + nz * h, zz = tz * c + bz * f + nz * i;
  const trace = xx + yy + zz;
  let w, x, y, z;
  if (trace >= Math.max(xx, yy, zz)) (w = 1 + trace), (x = zy - yz), (y = xz - zx), (z = yx - xy);
  else if (xx >= yy && xx >= zz) (w = zy - yz), (x = 1 + xx - yy - zz), (y = xy + yx), (z = xz + zx);
  else if (yy >= zz) (w = xz - zx), (x = xy + yx), (y = 1 - xx + yy - zz), (z = yz + zy);
  else (w = yx - xy), (x = xz + zx), (y = yz + zy), (z = 1 - xx - yy + zz);
  const scale = (w < 0 ? -1 : 1) / Math.sqrt(w * w + x * x + y * y + z * z);
  out[at] = w * scale;
  out[at + 1] = x * scale;
  out[at + 2] = y * scale;
  out[at + 3] = z * scale;
}

function rotateVertices(body) {
  const { start, around, faceQuats, faceAreas, faceWeights, quats, growth, nVertices, usual } = body;
  for (let v = 0; v < nVertices; v++) {
    const first = start[v], end = start[v + 1], r = 4 * around[first];
    let w = 0, x = 0, y = 0, z = 0, before = 0, after = 0;
    for (let e = first; e < end; e++) {
      const f = around[e], q = 4 * f;
      const along = faceQuats[q] * faceQuats[r] + faceQuats[q + 1] * faceQuats[r + 1] + faceQuats[q + 2] * faceQuats[r + 2] +
        faceQuats[q + 3] * faceQuats[r + 3];
      const weight = along < 0 ? -faceWeights[f] : faceWeights[f];
      w += weight * faceQuats[q];
      x += weight * faceQuats[q + 1];
      y += weight * faceQuats[q + 2];
      z += weight * faceQuats[q + 3];
      before += faceAreas[2 * f];
      after += faceAreas[2 * f + 1];
    }
    const norm = Math.sqrt(w * w + x * x + y * y + z * z), q = 4 * v;
    quats[q] = norm > 0 ? w / norm : usual[0];
    quats[q + 1] = norm > 0 ? x / norm : usual[1];
    quats[q + 2] = norm > 0 ? y / norm : usual[2];
    quats[q + 3] = norm > 0 ? z / norm : usual[3];
    growth[v] = before > 0 ? after / before : 1;
  }
}

// Vectors at rest, turned with their vertices.
function turnWithVertices(quats, rest, out) {
  for (let v = 0; v < rest.length / 3; v++) {
    const w = quats[4 * v], x = quats[4 * v + 1], y = quats[4 * v + 2], z = quats[4 * v + 3];
    const a = rest[3 * v], b = rest[3 * v + 1], c = rest[3 * v + 2];
    const tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
    out[3 * v] = a + w * tx + y * tz - z * ty;
    out[3 * v + 1] = b + w * ty + z * tx - x * tz;
    out[3 * v + 2] = c + w * tz + x * ty - y * tx;
  }
}
