// Gaussians of other programs: they stay as they are, and are only turned.
"use strict";

function openSplats(data) {
  const { means, quats, scales, colors, opacities } = data.arrays, count = opacities.length;
  const covariances = new Float32Array(6 * count), packed = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4).map((value) => value / norm), s = 3 * i;
    writeCovariance(w, x, y, z, scales[s] ** 2, scales[s + 1] ** 2, scales[s + 2] ** 2, covariances, 6 * i);
    packed[i] = Math.round(255 * opacities[i]) << 24;
    for (let c = 0; c < 3; c++) packed[i] |= Math.round(255 * colors[s + c]) << (8 * c);
  }
  const gaussians = { count, means, covariances, heaviest: new Uint8Array(count), shown: Uint8Array.of(1) };
  return { data, gaussians, colors: packed, projection: makeProjection(gaussians) };
}

function drawSplats({ data, gaussians, colors, projection }, { camera }) {
  const { target, radius } = camera.target ? camera : data.frame;
  const distance = (camera.zoom * radius * data.orbitMargin) / Math.sin(camera.fieldOfView / 2);
  const count = projectGaussians(gaussians, projection, orbitCamera({ ...camera, target, distance }));
  return { ellipses: sortEllipses(projection, colors, count), count };
}
