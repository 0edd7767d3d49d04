// Turn, zoom and move the hand with mouse, fingers and keys.
"use strict";

const TURN = 0.008; // rad a pixel
const KEY_TURN = Math.PI / 24;
const STEEPEST_VIEW = 1.5; // rad above and below
const NEAREST = 0.15, FARTHEST = 4; // of the first distance

function listenToGestures(viewer) {
  const { canvas } = viewer, pointers = new Map();
  const known = () => document.getElementById("help").classList.add("known");
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.classList.add("held");
  });
  const release = (event) => {
    pointers.delete(event.pointerId);
    if (pointers.size === 0) canvas.classList.remove("held");
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const others = [...pointers.keys()].filter((id) => id !== event.pointerId).map((id) => pointers.get(id));
    if (others.length > 0) pinch(viewer, before, now, others[0]);
    else if (event.shiftKey || event.buttons & 6) move(viewer, now[0] - before[0], now[1] - before[1]);
    else turn(viewer, (now[0] - before[0]) * TURN, (now[1] - before[1]) * TURN);
    pointers.set(event.pointerId, now);
    known();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1; // Firefox counts lines
    zoom(viewer, Math.exp(event.deltaY * lines * 0.0012));
    known();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const moves = {
      ArrowLeft: () => turn(viewer, -KEY_TURN, 0), ArrowRight: () => turn(viewer, KEY_TURN, 0),
      ArrowUp: () => turn(viewer, 0, -KEY_TURN), ArrowDown: () => turn(viewer, 0, KEY_TURN),
      "+": () => zoom(viewer, 0.9), "=": () => zoom(viewer, 0.9), "-": () => zoom(viewer, 1 / 0.9),
      0: () => goHome(viewer, 0),
    };
    if (!(event.key in moves)) return;
    event.preventDefault();
    moves[event.key]();
    known();
  });
}

function turn(viewer, right, down) {
  const { camera } = viewer;
  camera.azimuth += right;
  camera.elevation = Math.min(Math.max(camera.elevation + down, -STEEPEST_VIEW), STEEPEST_VIEW);
  show(viewer, true);
}

function zoom(viewer, factor) {
  viewer.camera.zoom = Math.min(Math.max(viewer.camera.zoom * factor, NEAREST), FARTHEST);
  show(viewer, true);
}

function move(viewer, right, down) {
  const { camera, canvas, facts } = viewer, side = Math.min(canvas.clientWidth, canvas.clientHeight) || 1;
  const metre = (2 * facts.frame.radius * camera.zoom) / side; // a pixel at the hand, nearly
  camera.shift = [camera.shift[0] + right * metre, camera.shift[1] + down * metre];
  show(viewer, true);
}

function pinch(viewer, before, now, other) {
  const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
  zoom(viewer, apart(before) / apart(now));
  move(viewer, (now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
}

function goHome(viewer, azimuth) {
  Object.assign(viewer.camera, homeCamera(), { azimuth });
  show(viewer, true);
}
