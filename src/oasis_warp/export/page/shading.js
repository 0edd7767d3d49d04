// Light on the posed surface, and the colours of the Gaussians in it (avatar/vertex_light.py): harmonics in the direction that
// skin faces, past what the hand hides of it, then the photo's shade for as long as skin faces as in the photo.
"use strict";

const GAMMA = 2.2; // light is sRGB to this power, nearly
const AS_IN_PHOTO = Math.cos((5 * Math.PI) / 180), TURNED_AWAY = Math.cos((20 * Math.PI) / 180);
const SAME_POSE = 0.9, OTHER_POSE = 0.5; // shares of the hand that face as in the photo
const SAME_VIEW = Math.cos((10 * Math.PI) / 180), OTHER_VIEW = Math.cos((35 * Math.PI) / 180);
const NEAREST = 1e-4; // least distance of a camera, of which a direction is taken [m]
const HALF_HAND = 0.08, SAME_PARALLAX = (2 * Math.PI) / 180, OTHER_PARALLAX = (7 * Math.PI) / 180; // where the photo is in doubt
const SAME_SKY = 0.08, OTHER_SKY = 0.25; // changes of the share of the sky that skin sees, as in avatar/vertex_light.py
const SAME_BESIDE = 0.02, OTHER_BESIDE = 0.08; // the same where the photo is in doubt
const IN_HOLLOWS = [1, 1.2, 1.35], LEAST_LIGHT = [0.05, 0.02, 0.01]; // of light in hollows, as in avatar/sky.py
const IN_CREVICES = [0.03, 0.012, 0.008], DEEP_INSIDE = 0.4, OUTSIDE = 0.6; // of light close to other skin, as there
const CLOSED = (15 * Math.PI) / 180, OPENED = (75 * Math.PI) / 180; // flexions between which folds open, as in avatar/folds.py
const UNSTRETCHED = 0.05, STRETCHED = 0.25; // logarithms of growth between which creases go flat, as in avatar/creases.py
const LITTLE = 0.25, COMPRESSED = 0.85; // logarithms of shrinking between which wrinkles grow, as there
const WRINKLE_HUE = [0.8, 1.08, 1.12]; // as in avatar/wrinkles.py // as in avatar/wrinkles.py
const LEAST_AREA = 1e-12; // of which a logarithm is taken [m^2]
const NO_JOINT = 255, STRETCH = 254; // of Gaussians that have no folds, and of those with creases
const WEAK = 0.3, DEEP = 0.6; // differences of shade from 1, up to which it is the skin's own, and from which it is not
const MAP_SEEN = [0.36, 0.6, 0.57], MAP_INVENTED = [0.89, 0.55, 0.28], MAP_SKIN = 0.35; // colours of the map; share of skin in it

function makeShading(body, { count }) {
  const n = body.nVertices;
  return {
    normals: new Float32Array(3 * n), factors: new Float32Array(4 * n), change: new Float32Array(n), nearby: new Float32Array(n),
    deep: new Float32Array(n), colors: new Uint32Array(count), sky: makeSky(body),
    opened: new Float32Array(2 * (body.nBones - 1)), // of each joint, the share of seen folds that is open, and of painted ones
    stretched: new Float32Array(n), // share of each vertex's creases that is flat; below 0, how deep its wrinkles are
  };
}

const between = (x, low, high) => Math.min(Math.max((x - low) / (high - low), 0), 1);

// How far each joint opens folds: beyond the flexion in the photo, and painted ones beyond a straight finger.
function openFolds(body, { opened }, angles) {
  const { straight, photo } = body.data.folds;
  for (let j = 0; j < straight.length; j++) {
    opened[2 * j] = between(angles[3 * j] - photo[j], CLOSED, OPENED);
    opened[2 * j + 1] = between(angles[3 * j] - straight[j], CLOSED, OPENED);
  }
}

// How far the pose stretches or compresses skin: the growth of the coarse faces around each vertex.
function flattenCreases({ posed, nVertices, data: { arrays } }, { stretched }) {
  const { skyVertices, skyFaces, skyCorners, skyShares, creaseAreas } = arrays, areas = new Float64Array(skyVertices.length);
  const point = (v) => posed.subarray(3 * skyVertices[v], 3 * skyVertices[v] + 3);
  for (let f = 0; f < skyFaces.length; f += 3) {
    const [a, b, c] = [point(skyFaces[f]), point(skyFaces[f + 1]), point(skyFaces[f + 2])];
    const ux = b[0] - a[0], uy = b[1] - a[1], uz = b[2] - a[2], vx = c[0] - a[0], vy = c[1] - a[1], vz = c[2] - a[2];
    const area = Math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx) / 2;
    for (let k = f; k < f + 3; k++) areas[skyFaces[k]] += area;
  }
  for (let v = 0; v < nVertices; v++) {
    let grown = 0;
    for (let k = 3 * v; k < 3 * v + 3; k++) grown += skyShares[k] * Math.log(Math.max(areas[skyCorners[k]], LEAST_AREA) / creaseAreas[skyCorners[k]]);
    stretched[v] = between(grown, UNSTRETCHED, STRETCHED) - between(-grown, LITTLE, COMPRESSED);
  }
}

// What the posed hand hides of a light, and what no longer hides the sky as in the photo.
function hideLight(body, { normals, sky, change, nearby }, { harmonics, albedo, seen }, hurry) {
  if (!albedo) return;
  exposeVertices(body, sky, normals, harmonics, hurry);
  if (!seen) return;
  for (let v = 0; v < body.nVertices; v++) change[v] = Math.max(sky.exposure[4 * v] - seen[v], 0); // what cast the shade has moved
  largestNearby(body, sky, change, nearby);
}

// Shares of the photo's shade that stay in a picture from `eye`: anywhere, and where the photo is in doubt.
function viewShares({ data, posed, nVertices }, eye) {
  const { photoEye } = data;
  if (!photoEye) return [1, 1];
  const middle = [0, 0, 0];
  for (let i = 0; i < 3 * nVertices; i++) middle[i % 3] += posed[i] / nVertices;
  const toward = eye.map((x, k) => x - middle[k]), far = Math.max(Math.hypot(...toward), NEAREST), photoFar = Math.hypot(...photoEye);
  const along = (toward[0] * photoEye[0] + toward[1] * photoEye[1] + toward[2] * photoEye[2]) / (far * photoFar);
  const turned = 2 - 2 * along + (HALF_HAND * (1 / far - 1 / photoFar)) ** 2;
  return [between(along, OTHER_VIEW, SAME_VIEW), between(-turned, -(OTHER_PARALLAX ** 2), -(SAME_PARALLAX ** 2))];
}

// Factors of the colours of every vertex and the share of the photo's weak shade that is left, into shading.factors; that
// of deep shade into shading.deep: for it, and where the photo is in doubt, the change of the sky is the largest nearby.
// Deep shade also ends with the photo's pose, on all of the hand at once. Of both the first share of `viewed` is seen, and of
// the Gaussians' own, where the photo is in doubt, the second.
function lightVertices(body, shading, light, viewed) {
  const { shade, facing, doubt } = body.data.arrays, { normals, factors, sky, change, nearby, deep } = shading, { albedo, seen } = light;
  const bounce = albedo && albedo.map((a) => [2.0404 * a - 0.3324, -4.7951 * a + 0.6417, 2.7552 * a + 0.6903]);
  const keptAt = (v) => {
    const a = 3 * v;
    if (!facing) return 0;
    return between(normals[a] * facing[a] + normals[a + 1] * facing[a + 1] + normals[a + 2] * facing[a + 2], TURNED_AWAY, AS_IN_PHOTO);
  };
  let held = 0;
  for (let v = 0; v < body.nVertices; v++) held += keptAt(v) / body.nVertices;
  held = between(held, OTHER_POSE, SAME_POSE);
  for (let v = 0; v < body.nVertices; v++) {
    const x = normals[3 * v], y = normals[3 * v + 1], z = normals[3 * v + 2], kept = keptAt(v);
    const unsure = doubt ? doubt[v] : 0, mixed = (sure, beside) => sure + unsure * (beside - sure);
    const same = mixed(SAME_SKY, SAME_BESIDE), other = mixed(OTHER_SKY, OTHER_BESIDE);
    const left = (moved) => viewed[0] * (albedo && seen ? kept * (1 - between(moved, same, other)) : kept);
    deep[v] = held * left(nearby[v]);
    lightVertex(light, bounce, x, y, z, sky.exposure, body.contact.closeness[v], factors, 4 * v);
    if (shade) for (let c = 0; c < 3; c++) factors[4 * v + c] *= 1 + deep[v] * (shade[3 * v + c] - 1);
    const weak = left(mixed(change[v], nearby[v]));
    let most = 0; // of the light's own shade: where it is deep, weak shade goes with it
    if (shade) for (let c = 0; c < 3; c++) most = Math.max(most, Math.abs(shade[3 * v + c] - 1));
    const close = 1 - unsure * (1 - viewed[1]);
    factors[4 * v + 3] = close * (weak + between(most, WEAK, DEEP) * (Math.min(weak, deep[v]) - weak));
    deep[v] *= close;
  }
}

// Factors of colours that face (x, y, z), past what is hidden of the light there, this close to other skin.
function lightVertex({ harmonics: h, limits }, bounce, x, y, z, exposure, closeness, factors, at) {
  const xy = x * y, yz = y * z, zz = 3 * z * z - 1, xz = x * z, xx = x * x - y * y;
  const hidden = bounce ? closeness * between(OUTSIDE - exposure[at], 0, OUTSIDE - DEEP_INSIDE) : 0;
  for (let c = 0; c < 3; c++) {
    let got = h[c] + h[3 + c] * x + h[6 + c] * y + h[9 + c] * z + h[12 + c] * xy + h[15 + c] * yz + h[18 + c] * zz +
      h[21 + c] * xz + h[24 + c] * xx;
    got = Math.min(Math.max(got, limits[c]), limits[3 + c]);
    if (bounce) {
      const e = exposure[at + 1 + c], [p, q, r] = bounce[c];
      const bounced = Math.max(e, ((e * p + q) * e + r) * e); // Jimenez et al. 2016
      got *= LEAST_LIGHT[c] + (1 - LEAST_LIGHT[c]) * bounced ** IN_HOLLOWS[c];
      got *= 1 - hidden * (1 - IN_CREVICES[c]);
    }
    factors[at + c] = got ** (1 / GAMMA);
  }
}

// Colours and opacities of all Gaussians, a byte each, into shading.colors. `light` is null for even light.
function colorGaussians(body, gaussians, shading, light) {
  const { colors: own, fineShade, even, folds, foldJoints, foldBetween, wrinkles, invented } = body.data.arrays;
  const { count, corners, shares, heaviest, shown, opacities } = gaussians;
  const { factors, colors, deep, opened, stretched } = shading;
  for (let i = 0; i < count; i++) {
    if (!shown[heaviest[i]]) continue;
    const a = 3 * i, p = shares[a], q = shares[a + 1], r = shares[a + 2];
    const u = 4 * corners[a], v = 4 * corners[a + 1], w = 4 * corners[a + 2];
    const weak = light ? p * factors[u + 3] + q * factors[v + 3] + r * factors[w + 3] : 1;
    let stays = 0, open = 0, seenOpen = 0, wrinkled = 0;
    if (light && foldJoints[2 * i] === STRETCH) {
      const share = p * stretched[corners[a]] + q * stretched[corners[a + 1]] + r * stretched[corners[a + 2]];
      open = Math.max(share, 0), wrinkled = Math.max(-share, 0);
    } else if (light && foldJoints[2 * i] < NO_JOINT) {
      const painted = invented ? p * invented[corners[a]] + q * invented[corners[a + 1]] + r * invented[corners[a + 2]] : 0;
      const j = 2 * foldJoints[2 * i], k = 2 * foldJoints[2 * i + 1], t = foldBetween[i];
      seenOpen = (1 - painted) * (opened[j] + t * (opened[k] - opened[j]));
      open = seenOpen + painted * (opened[j + 1] + t * (opened[k + 1] - opened[j + 1])) * (1 - weak);
    }
    if (light && fineShade) {
      const red = Math.abs(fineShade[a] - 1), green = Math.abs(fineShade[a + 1] - 1), blue = Math.abs(fineShade[a + 2] - 1);
      const share = between(Math.max(red, green, blue), WEAK, DEEP);
      stays = (1 - share) * weak * (1 - seenOpen) +
        share * (p * deep[corners[a]] + q * deep[corners[a + 1]] + r * deep[corners[a + 2]]);
    }
    let packed = Math.round(255 * opacities[i]) << 24;
    for (let c = 0; c < 3; c++) {
      let factor = even[c];
      if (light) {
        factor = p * factors[u + c] + q * factors[v + c] + r * factors[w + c];
        if (stays) factor *= 1 + stays * (fineShade[a + c] - 1);
        if (open) factor *= Math.exp(open * folds[a + c]);
        if (wrinkled) factor *= Math.exp(wrinkled * wrinkles[i] * WRINKLE_HUE[c]);
      }
      packed |= Math.round(255 * Math.min(Math.max(own[a + c] * factor, 0), 1)) << (8 * c);
    }
    colors[i] = packed;
  }
}

// Which skin a photo showed and which is painted, instead of colours.
function mapGaussians(body, gaussians, shading) {
  const { invented, colors: own } = body.data.arrays, { corners, shares, heaviest, shown } = gaussians;
  for (let i = 0; i < gaussians.count; i++) {
    if (!shown[heaviest[i]]) continue;
    let share = 0;
    for (let k = 3 * i; k < 3 * i + 3; k++) share += shares[k] * invented[corners[k]];
    const skin = (own[3 * i] + own[3 * i + 1] + own[3 * i + 2]) / 3;
    let packed = Math.round(255 * gaussians.opacities[i]) << 24;
    for (let c = 0; c < 3; c++) {
      const mark = MAP_SEEN[c] + share * (MAP_INVENTED[c] - MAP_SEEN[c]);
      packed |= Math.round(255 * Math.min(mark * (1 - MAP_SKIN) + MAP_SKIN * skin, 1)) << (8 * c);
    }
    shading.colors[i] = packed;
  }
}
