// The data of the page: one stream of gzip in base64, written by page_file.py. Arrays of whole numbers with a "step"
// are values over that step.
"use strict";

const ARRAYS = {
  f4: Float32Array, u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, u4: Uint32Array, i4: Int32Array,
};

async function readData(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  for (const [name, { type, count, offset, step }] of Object.entries(header.arrays)) {
    const stored = new ARRAYS[type](buffer, offset, count);
    arrays[name] = step ? inUnits(stored, step) : stored;
  }
  return { ...header.facts, arrays };
}

function inUnits(stored, step) {
  const out = new Float32Array(stored.length);
  for (let i = 0; i < stored.length; i++) out[i] = stored[i] * step;
  return out;
}
