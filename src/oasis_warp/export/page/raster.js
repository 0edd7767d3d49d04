// Draw ellipses without a graphics card, in a worker of its own: from the nearest to the farthest, so that what lies
// behind opaque skin costs next to nothing. The rules are those of the fragment shader of graphics.js.
"use strict";

// What is let through where nothing more is drawn; the largest radius [sigmas]; what alpha is divided by. In a hurry skin
// that faces away is missing, so that the background would shine through: alpha is raised, and outlines are a bit harder.
const EXACT = { opaque: 1 / 100, reach: 3.33, cover: 1 };
const HURRIED = { opaque: 1 / 16, reach: 2.1, cover: 0.7 };
const TILE = 8; // pixels a side of the tiles that count where the picture is still open
const EXP_STEPS = 4096, EXP_END = 3.33 ** 2; // table of exp(-x / 2)
const FADES = Float32Array.from({ length: 256 }, (_, byte) => 2 * Math.log(Math.max(byte, 1))); // where alpha is 1 / 255
const EXP = Float32Array.from({ length: EXP_STEPS + 2 }, (_, k) => Math.exp((-(k + 0.5) / EXP_STEPS) * EXP_END / 2));

function makeRaster(width, height) {
  const across = Math.ceil(width / TILE), down = Math.ceil(height / TILE);
  return {
    width, height, across, clear: new Float32Array(width * height), sums: new Float32Array(3 * width * height),
    open: new Uint8Array(across * down),
  };
}

function clearRaster({ clear, sums, open, width, height, across }) {
  clear.fill(1);
  sums.fill(0);
  for (let t = 0; t < open.length; t++) {
    const x = (t % across) * TILE, y = Math.floor(t / across) * TILE;
    open[t] = Math.min(TILE, width - x) * Math.min(TILE, height - y);
  }
}

function drawEllipses(raster, ellipses, count, { opaque, reach }) {
  const { width, height, across, open } = raster, bytes = new Uint8Array(ellipses.buffer);
  clearRaster(raster);
  for (let i = count - 1; i >= 0; i--) {
    const o = 6 * i, byte = bytes[24 * i + 23];
    if (byte === 0) continue;
    const x = ellipses[o], y = ellipses[o + 1], ax = ellipses[o + 2], ay = ellipses[o + 3], thin = ellipses[o + 4] ** 2;
    const far = Math.min(reach * reach, FADES[byte]), tall = Math.sqrt(far * (ay * ay + thin * ax * ax));
    const wide = Math.sqrt(far * (ax * ax + thin * ay * ay));
    const left = Math.max(Math.ceil(x - wide - 0.5), 0), right = Math.min(Math.floor(x + wide - 0.5), width - 1);
    const top = Math.max(Math.ceil(y - tall - 0.5), 0), bottom = Math.min(Math.floor(y + tall - 0.5), height - 1);
    if (left > right || top > bottom) continue;
    let any = 0;
    for (let v = top >> 3; v <= bottom >> 3; v++) for (let u = left >> 3; u <= right >> 3; u++) any |= open[v * across + u];
    if (any === 0) continue;
    drawEllipse(raster, bytes, i, byte / 255, x, y, ax, ay, thin, far, left, right, top, bottom, opaque);
  }
}

function drawEllipse(raster, bytes, i, opacity, x, y, ax, ay, thin, far, left, right, top, bottom, opaque) {
  const { width, across, clear, sums, open } = raster;
  const red = bytes[24 * i + 20], green = bytes[24 * i + 21], blue = bytes[24 * i + 22];
  // The squared distance in standard deviations is p dx^2 + 2 q dx dy + r dy^2.
  const size = ax * ax + ay * ay, scale = 1 / (size * size), p = (ax * ax + (ay * ay) / thin) * scale;
  const q = (ax * ay * (1 - 1 / thin)) * scale, r = (ay * ay + (ax * ax) / thin) * scale, steps = EXP_STEPS / EXP_END;
  for (let row = top; row <= bottom; row++) {
    const dy = row + 0.5 - y, half = q * dy, room = half * half - p * (r * dy * dy - far);
    if (room <= 0) continue;
    const root = Math.sqrt(room), first = Math.max(Math.ceil(x + (-half - root) / p - 0.5), left);
    const last = Math.min(Math.floor(x + (root - half) / p - 0.5), right), tiles = (row >> 3) * across;
    for (let column = first, at = row * width + first; column <= last; column++, at++) {
      const through = clear[at];
      if (through < opaque) continue;
      const dx = column + 0.5 - x, away = (p * dx + 2 * half) * dx + r * dy * dy;
      const alpha = Math.min(opacity * EXP[(away * steps) | 0], 0.999), part = through * alpha;
      sums[3 * at] += part * red;
      sums[3 * at + 1] += part * green;
      sums[3 * at + 2] += part * blue;
      clear[at] = through - part;
      if (through - part < opaque) open[tiles + (column >> 3)]--;
    }
  }
}

// As the browser wants it: a byte a channel, colours not multiplied with alpha.
function pixelsOf({ clear, sums, width, height }, { opaque, cover }) {
  const out = new Uint8ClampedArray(4 * width * height);
  for (let i = 0; i < clear.length; i++) {
    if (clear[i] === 1) continue;
    const alpha = clear[i] < opaque ? 1 : Math.min((1 - clear[i]) / cover, 1), scale = 1 / (1 - clear[i]);
    out[4 * i] = sums[3 * i] * scale;
    out[4 * i + 1] = sums[3 * i + 1] * scale;
    out[4 * i + 2] = sums[3 * i + 2] * scale;
    out[4 * i + 3] = 255 * alpha;
  }
  return out;
}

if (typeof WorkerGlobalScope !== "undefined") {
  let raster = null;
  self.onmessage = ({ data: { ellipses, count, hurry, width, height } }) => {
    try {
      if (raster?.width !== width || raster?.height !== height) raster = makeRaster(width, height);
      const how = hurry ? HURRIED : EXACT;
      drawEllipses(raster, ellipses, count, how);
      const pixels = pixelsOf(raster, how);
      self.postMessage({ pixels }, [pixels.buffer]);
    } catch (error) {
      console.error(error);
      self.postMessage({ failed: String(error.message ?? error) });
    }
  };
}
