// The viewer: what is shown, and pictures of it from the worker, one at a time, the newest wish next.
"use strict";

const SLOW = 33, QUICK = 20; // ms a picture above which moving pictures are drawn smaller, and below which larger again
const REST = 250; // ms without a change after which nothing moves
const MIN_SCALE = 0.5; // of the window's own pixels
const MAX_SCALE = 2; // of CSS pixels: more are not seen

function makeViewer(canvas, facts, worker, { draw, facing }) {
  const viewer = {
    canvas, facts, draw, facing, worker, angles: Float32Array.from(facts.start.angles), look: facts.start.look, camera: { ...homeCamera(), target: facts.start.target },
    wishes: new Map(), wanted: false, waiting: 0, next: 1, scale: 1, moving: 0, shown: 0, times: [],
  };
  worker.onmessage = ({ data }) => {
    const { resolve, reject } = viewer.wishes.get(data.id);
    viewer.wishes.delete(data.id);
    if (data.failed) reject(notDrawn(data.failed));
    else resolve(data);
  };
  new ResizeObserver(() => show(viewer)).observe(canvas);
  canvas.addEventListener("forgotten", () => show(viewer));
  const loop = () => (requestAnimationFrame(loop), step(viewer));
  loop();
  return viewer;
}

class Problem extends Error {}

const notDrawn = (reason) => new Problem(`A picture could not be drawn (${reason}); choose another, or load the page again.`);

const homeCamera = () => ({ azimuth: 0, elevation: 0, zoom: 1, shift: [0, 0] });

// Ask for a new picture of what is wanted now.
function show(viewer, moving = false) {
  viewer.wanted = true;
  if (moving) viewer.moving = performance.now();
}

// At most two pictures are under way: one is posed while the one before is drawn. main.js says which fail.
function step(viewer) {
  const now = performance.now();
  viewer.tick?.(now);
  // What was drawn in a hurry while it moved is drawn again in full once it rests.
  if (viewer.moving && now - viewer.moving > REST) Object.assign(viewer, { moving: 0, wanted: true });
  if (!viewer.wanted || viewer.waiting >= 2) return;
  viewer.wanted = false;
  viewer.waiting++;
  paint(viewer).finally(() => viewer.waiting--).catch((error) => {
    if (!viewer.first) throw error;
    viewer.first(error);
  });
}

async function paint(viewer) {
  const full = Math.min(devicePixelRatio || 1, MAX_SCALE), scale = full * (viewer.moving ? viewer.scale : 1);
  const box = viewer.canvas.getBoundingClientRect();
  const width = Math.max(1, Math.round(box.width * scale)), height = Math.max(1, Math.round(box.height * scale));
  const found = await ask(viewer, cameraOf(viewer, width, height), viewer.look, viewer.angles, viewer.moving > 0);
  await viewer.draw(found, width, height);
  countPicture(viewer);
  viewer.first?.();
}

// Keep the time of pictures in motion, and draw smaller ones where they come too slowly.
function countPicture(viewer) {
  const now = performance.now(), took = now - viewer.shown;
  viewer.shown = now;
  if (!viewer.moving || took > 500) return (viewer.times.length = 0);
  viewer.times.push(took);
  if (viewer.times.length < 12) return;
  const usual = viewer.times.sort((a, b) => a - b)[6];
  viewer.times.length = 0;
  if (usual > SLOW * 1.15) viewer.scale = Math.max(MIN_SCALE, viewer.scale * 0.85);
  else if (usual < QUICK) viewer.scale = Math.min(1, viewer.scale * 1.1);
}

function ask(viewer, camera, look, angles, hurry = false) {
  return new Promise((resolve, reject) => {
    const id = viewer.next++;
    viewer.wishes.set(id, { resolve, reject });
    viewer.worker.postMessage({ id, camera, look, angles, hurry, facing: viewer.facing });
  });
}

function cameraOf({ camera, facts }, width, height) {
  const { azimuth, elevation, zoom, target, shift: [right, down] } = camera, { radius } = facts.frame;
  const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
  const axes = [[ca, 0, -sa], [sa * se, ce, ca * se]];
  const middle = target.map((x, k) => x - right * axes[0][k] - down * axes[1][k]);
  return { azimuth, elevation, zoom, target: middle, radius, fieldOfView: facts.fieldOfView, width, height };
}

// A picture as a PNG with a transparent background. With `fit` the hand fills it, as `oasis render` draws it.
async function takePicture(viewer, { angles, look, azimuth, elevation, width, height, fit = false } = {}) {
  const box = viewer.canvas.getBoundingClientRect(), ratio = Math.min(devicePixelRatio || 1, MAX_SCALE);
  const w = width ?? Math.round(box.width * ratio), h = height ?? Math.round(box.height * ratio);
  const camera = { ...cameraOf(viewer, w, h), ...(fit ? { target: null, zoom: 1 } : {}) };
  camera.azimuth = azimuth ?? camera.azimuth;
  camera.elevation = elevation ?? camera.elevation;
  await viewer.draw(await ask(viewer, camera, look ?? viewer.look, angles ?? viewer.angles), w, h);
  return new Promise((resolve) => {
    viewer.canvas.toBlob((blob) => resolve(blob), "image/png"); // reads what was drawn in this turn
    show(viewer);
  });
}
