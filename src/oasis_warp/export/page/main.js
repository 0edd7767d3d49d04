// Start: the worker opens the data, then the panel is filled and the first picture drawn.
"use strict";

const text = (id) => byId(id).textContent;
const makeWorker = (id) => new Worker(URL.createObjectURL(new Blob([text(id)], { type: "text/javascript" })));

// How pictures are drawn, and whether in a hurry only skin that faces the viewer; the address may end in #graphics or
// #processor to choose. A browser without WebGL 2 has no choice.
function makeDrawing(canvas) {
  const choices = { "#graphics": () => Boolean(openGraphics(document.createElement("canvas"))), "#processor": () => false };
  const graphics = (choices[location.hash] ?? hasGraphicsCard)();
  if (graphics) return { draw: makeGraphics(canvas), facing: false, note: "" };
  const draw = makeProcessor(canvas, makeWorker("raster"));
  return { draw, facing: true, note: "Drawn without a graphics card." };
}

function start() {
  const worker = makeWorker("worker");
  worker.postMessage({ open: text("data") });
  const drawing = makeDrawing(byId("canvas")); // meanwhile
  return new Promise((resolve, reject) => {
    worker.onerror = (event) => reject(new Problem(event.message || "The page's worker does not start in this browser."));
    worker.onmessage = ({ data }) => {
      if (data.failed) return reject(new Problem(`The hand could not be opened (${data.failed}); export it again.`));
      byId("status").textContent = drawing.note;
      const viewer = makeViewer(byId("canvas"), data.opened, worker, drawing);
      viewer.player = fillPanel(viewer);
      listenToGestures(viewer);
      if (matchMedia("(max-width: 46rem)").matches) byId("fold").click();
      viewer.first = (error) => {
        viewer.first = null;
        if (error) return reject(error);
        performance.mark("first-picture");
        resolve(viewer);
      };
      show(viewer);
    };
  });
}

const fail = (error) => {
  byId("status").textContent = error instanceof Problem ? error.message : `Something went wrong: ${error.message}`;
};
window.addEventListener("error", (event) => fail(event.error ?? event));
window.addEventListener("unhandledrejection", (event) => fail(event.reason));

// For scripts and tests: `await oasis.ready`, then `await oasis.picture({ pose: "fist", azimuth: 0.5, width: 512 ... })`.
window.oasis = { ready: start() };
window.oasis.ready.then((viewer) => {
  window.oasis.viewer = viewer;
  window.oasis.picture = ({ pose, ...options } = {}) => {
    const angles = viewer.facts.poses.find(({ name }) => name === pose)?.angles;
    return takePicture(viewer, { angles, ...options });
  };
}, fail);
