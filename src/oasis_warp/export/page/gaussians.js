// Gaussians bound to the posed surface (the operator pose_on_mesh): P to vertices, then Q to faces.
"use strict";

function makeGaussians(body) {
  const { vertexIndex, faceIndex, barycentrics, quats, opacities } = body.data.arrays;
  const nOnVertices = vertexIndex.length, nOnFaces = faceIndex.length, count = nOnVertices + nOnFaces;
  const corners = new Uint16Array(3 * count), shares = new Float32Array(3 * count), heaviest = new Uint16Array(count);
  for (let i = 0; i < nOnVertices; i++) {
    corners.fill(vertexIndex[i], 3 * i, 3 * i + 3);
    shares[3 * i] = 1;
    heaviest[i] = vertexIndex[i];
  }
  for (let k = 0; k < nOnFaces; k++) {
    const i = nOnVertices + k, b0 = barycentrics[2 * k], b1 = barycentrics[2 * k + 1];
    shares.set([b0, b1, 1 - b0 - b1], 3 * i);
    for (let c = 0; c < 3; c++) corners[3 * i + c] = body.faces[3 * faceIndex[k] + c];
    let most = 3 * i;
    for (let c = most + 1; c < 3 * i + 3; c++) if (shares[c] > shares[most]) most = c;
    heaviest[i] = corners[most];
  }
  for (let i = 0; i < count; i++) {
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    for (let k = 0; k < 4; k++) quats[4 * i + k] /= norm;
  }
  return {
    count, nOnVertices, corners, shares, heaviest, opacities, shown: new Uint8Array(body.nVertices),
    means: new Float32Array(3 * count), covariances: new Float32Array(6 * count), // xx, xy, xz, yy, yz, zz
  };
}

function poseGaussians(body, gaussians) {
  const { posed, quats: turns, growth, faceGrowth } = body, { faceIndex, offsets, quats, scales } = body.data.arrays;
  const { count, nOnVertices, corners, shares, heaviest, shown, means, covariances } = gaussians;
  for (let i = 0; i < count; i++) {
    if (!shown[heaviest[i]]) continue;
    let w, x, y, z, grown;
    if (i < nOnVertices) {
      const v = corners[3 * i], q = 4 * v;
      w = turns[q], x = turns[q + 1], y = turns[q + 2], z = turns[q + 3];
      grown = growth[v];
      const a = offsets[3 * i], b = offsets[3 * i + 1], c = offsets[3 * i + 2];
      const tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
      means[3 * i] = posed[3 * v] + a + w * tx + y * tz - z * ty;
      means[3 * i + 1] = posed[3 * v + 1] + b + w * ty + z * tx - x * tz;
      means[3 * i + 2] = posed[3 * v + 2] + c + w * tz + x * ty - y * tx;
    } else {
      const r = 4 * heaviest[i];
      let mx = 0, my = 0, mz = 0;
      w = x = y = z = 0;
      for (let k = 3 * i; k < 3 * i + 3; k++) {
        const share = shares[k], v = corners[k], q = 4 * v;
        mx += share * posed[3 * v];
        my += share * posed[3 * v + 1];
        mz += share * posed[3 * v + 2];
        const along = turns[q] * turns[r] + turns[q + 1] * turns[r + 1] + turns[q + 2] * turns[r + 2] +
          turns[q + 3] * turns[r + 3];
        const signed = along < 0 ? -share : share;
        w += signed * turns[q];
        x += signed * turns[q + 1];
        y += signed * turns[q + 2];
        z += signed * turns[q + 3];
      }
      means[3 * i] = mx;
      means[3 * i + 1] = my;
      means[3 * i + 2] = mz;
      const norm = 1 / Math.sqrt(w * w + x * x + y * y + z * z);
      w *= norm, x *= norm, y *= norm, z *= norm;
      grown = faceGrowth[faceIndex[i - nOnVertices]];
    }
    const factor = Math.min(Math.max(grown, 1), MAX_GROWTH); // scales grow with the root of the area, and do not shrink
    const a = quats[4 * i], b = quats[4 * i + 1], c = quats[4 * i + 2], d = quats[4 * i + 3];
    writeCovariance(
      w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
      w * d + x * c - y * b + z * a, scales[3 * i] ** 2 * factor, scales[3 * i + 1] ** 2 * factor,
      scales[3 * i + 2] ** 2 * factor, covariances, 6 * i,
    );
  }
}

// R diag(variances) R^T of a unit quaternion.
function writeCovariance(w, x, y, z, s0, s1, s2, out, at) {
  const r00 = 1 - 2 * (y * y + z * z), r01 = 2 * (x * y - w * z), r02 = 2 * (x * z + w * y);
  const r10 = 2 * (x * y + w * z), r11 = 1 - 2 * (x * x + z * z), r12 = 2 * (y * z - w * x);
  const r20 = 2 * (x * z - w * y), r21 = 2 * (y * z + w * x), r22 = 1 - 2 * (x * x + y * y);
  out[at] = s0 * r00 * r00 + s1 * r01 * r01 + s2 * r02 * r02;
  out[at + 1] = s0 * r00 * r10 + s1 * r01 * r11 + s2 * r02 * r12;
  out[at + 2] = s0 * r00 * r20 + s1 * r01 * r21 + s2 * r02 * r22;
  out[at + 3] = s0 * r10 * r10 + s1 * r11 * r11 + s2 * r12 * r12;
  out[at + 4] = s0 * r10 * r20 + s1 * r11 * r21 + s2 * r12 * r22;
  out[at + 5] = s0 * r20 * r20 + s1 * r21 * r21 + s2 * r22 * r22;
}
