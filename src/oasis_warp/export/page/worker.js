// The worker: poses, lights, projects and sorts. A message asks for one picture; the answer holds its ellipses.
"use strict";

let hand = null;

async function openHand(base64) {
  const data = await readData(base64);
  if (data.arrays.means) return openSplats(data);
  for (const light of Object.values(data.lights)) light.seen = light.albedo ? data.arrays.seen : null;
  const body = makeBody(data), gaussians = makeGaussians(body);
  return {
    body, gaussians, shading: makeShading(body, gaussians), projection: makeProjection(gaussians), angles: "", look: "", viewed: [1, 1],
    partly: false, // whether a hurry left something out of the pose
    skips: false, // whether it left out the colours
  };
}

function poseHand({ body, shading }, angles) {
  poseSurface(body, angles);
  giveWay(body, angles);
  rotateFaces(body);
  rotateVertices(body);
  turnWithVertices(body.quats, body.data.arrays.normals, shading.normals);
  openFolds(body, shading, angles);
  flattenCreases(body, shading);
}

// In even light and on the map colours do not depend on the pose.
function paintHand({ body, gaussians, shading }, look, viewed, posed, hurry) {
  if (look === "map") return mapGaussians(body, gaussians, shading);
  const light = body.data.lights[look] ?? null;
  if (light && posed) hideLight(body, shading, light, hurry);
  if (light) lightVertices(body, shading, light, viewed);
  return colorGaussians(body, gaussians, shading, light);
}

// One picture. Nothing is computed again that did not change. In a hurry colours are new in every other picture and
// shadows may lag behind, and if `facing` skin that faces away is left out; the next picture without a hurry makes up
// for it.
function drawHand(hand, wish) {
  if (!hand.body) return drawSplats(hand, wish);
  const { angles, look, camera, hurry = false, facing = false } = wish;
  const { body, gaussians, shading, projection } = hand, key = angles.join(), moved = key !== hand.angles;
  if (moved) poseHand(hand, angles);
  const { target, radius } = camera.target ? camera : frameSurface(body.posed);
  const distance = (camera.zoom * radius * body.data.orbitMargin) / Math.sin(camera.fieldOfView / 2);
  const view = orbitCamera({ ...camera, target, distance }), partly = moved && hurry;
  markShown(body, gaussians, shading.normals, view.eye, partly && facing);
  if (moved || hand.partly) poseGaussians(body, gaussians);
  const same = partly && look === hand.look, skips = same && hand.partly && !hand.skips;
  const relit = moved || hand.partly || look !== hand.look, viewed = viewShares(body, view.eye);
  if ((relit || viewed.join() !== hand.viewed.join()) && !skips) paintHand(hand, look, viewed, relit, same);
  Object.assign(hand, { angles: key, look, viewed: skips ? hand.viewed : viewed, partly, skips });
  if (hurry && facing && !partly) markShown(body, gaussians, shading.normals, view.eye, true);
  const count = projectGaussians(gaussians, projection, view);
  return { ellipses: sortEllipses(projection, shading.colors, count), count };
}

if (typeof self !== "undefined" && typeof WorkerGlobalScope !== "undefined") {
  self.onmessage = async ({ data: message }) => {
    try {
      if (message.open) {
        hand = await openHand(message.open);
        const { arrays, ...facts } = (hand.body ?? hand).data;
        self.postMessage({ opened: { ...facts, count: hand.gaussians.count } });
        return;
      }
      const start = performance.now(), { ellipses, count } = drawHand(hand, message);
      const took = performance.now() - start;
      self.postMessage({ id: message.id, ellipses, count, hurry: message.hurry && Boolean(hand.body), took }, [ellipses.buffer]);
    } catch (error) {
      console.error(error);
      self.postMessage({ id: message.id, failed: String(error.message ?? error) });
    }
  };
}
