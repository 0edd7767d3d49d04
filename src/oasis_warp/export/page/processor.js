// Pictures from the worker of raster.js, put on the canvas.
"use strict";

function makeProcessor(canvas, worker) {
  const context = canvas.getContext("2d"), waiting = [];
  worker.onmessage = ({ data: { pixels, failed } }) => {
    const { width, height, done, fail } = waiting.shift();
    if (failed) return fail(notDrawn(failed));
    sizeCanvas(canvas, width, height);
    context.putImageData(new ImageData(pixels, width, height), 0, 0);
    done();
  };
  return ({ ellipses, count, hurry }, width, height) => new Promise((done, fail) => {
    waiting.push({ width, height, done, fail });
    worker.postMessage({ ellipses, count, hurry, width, height }, [ellipses.buffer]);
  });
}
