// Pose the hand: joint angles -> surface -> Gaussians bound to it. The formulas are those of the Python operators
// bone_transforms, skin, face_rotations and pose_on_mesh; quaternions are wxyz, lengths metres.
"use strict";

const FLAT = 1e-6; // twice the area over the longest edge squared, up to which a face is flat
const DAMPING = 0.5e-6; // added to both areas of a ratio, over the longest rest edge squared
const MAX_GROWTH = 1e4; // limits of area ratios

function makeBody(data) {
  const { vertices, faces, weights, correctives, reach } = data.arrays;
  const body = {
    data, faces, rest: vertices, nVertices: vertices.length / 3, nFaces: faces.length / 3, nBones: data.parents.length,
  };
  body.skin = nonZero(weights, body.nVertices, body.nBones);
  body.bends = nonZeroTriples(correctives, reach, body.nVertices);
  body.planes = restPlanes(body);
  Object.assign(body, facesAround(body));
  body.contact = makeContact(body);
  body.posed = new Float32Array(3 * body.nVertices);
  body.shaped = new Float32Array(3 * body.nVertices);
  body.faceQuats = new Float32Array(4 * body.nFaces);
  body.faceAreas = new Float32Array(2 * body.nFaces); // damped, rest and posed
  body.faceGrowth = new Float32Array(body.nFaces);
  body.faceWeights = new Float32Array(body.nFaces);
  body.quats = new Float32Array(4 * body.nVertices);
  body.growth = new Float32Array(body.nVertices);
  return body;
}

// Rows of a matrix without their zeros: entries start[r] to start[r + 1] of columns and values.
function nonZero(matrix, rows, width) {
  const start = new Uint32Array(rows + 1), columns = [], values = [];
  for (let r = 0; r < rows; r++) {
    for (let c = 0; c < width; c++) {
      const value = matrix[width * r + c];
      if (value) columns.push(c), values.push(value);
    }
    start[r + 1] = columns.length;
  }
  return { start, columns: Uint8Array.from(columns), values: Float32Array.from(values) };
}

// For each corrective the vertices that it moves, and how far: correctives are [C, V, 3], in units of reach, [C].
function nonZeroTriples(correctives, reach, rows) {
  const out = [];
  for (let first = 0; first < correctives.length; first += 3 * rows) {
    const index = [], moves = [], unit = reach[out.length];
    for (let v = 0; v < rows; v++) {
      const x = correctives[first + 3 * v], y = correctives[first + 3 * v + 1], z = correctives[first + 3 * v + 2];
      if (x || y || z) index.push(v), moves.push(x * unit, y * unit, z * unit);
    }
    out.push({ index: Uint32Array.from(index), moves: Float32Array.from(moves) });
  }
  return out;
}

// Rotation and place (rows of 3 x 4) of every bone, and the strengths of the correctives.
function boneTransforms(body, angles) {
  const { parents, orientation, translation } = body.data, { joints, axes } = body.data.arrays;
  const transforms = new Float64Array(12 * body.nBones), bends = new Float64Array(body.bends.length);
  const each = bends.length / (body.nBones - 1); // correctives a bone: 2 of its flexion, or 9 of its whole rotation
  for (let j = 0; j < body.nBones; j++) {
    let own = orientation;
    if (j > 0) {
      const at = 3 * (j - 1), turn = (k) => axisRotation(axes.subarray(9 * j + 3 * k, 9 * j + 3 * k + 3), angles[at + k]);
      own = product(product(turn(0), turn(1)), turn(2));
      if (each === 9) {
        const about = (k) => axisRotation([+(k === 0), +(k === 1), +(k === 2)], angles[at + k]);
        bends.set(product(product(about(0), about(1)), about(2)).map((r, k) => r - +(k % 4 === 0)), 3 * at);
      } else {
        const c = 1 - Math.cos(angles[at]);
        bends[2 * j - 2] = c;
        bends[2 * j - 1] = c * c;
      }
    }
    const parent = j > 0 ? transforms.subarray(12 * parents[j], 12 * parents[j] + 12) : null;
    const joint = joints.subarray(3 * j, 3 * j + 3);
    const whole = parent ? product(linearPart(parent), own) : own;
    const place = parent ? moved(parent, joint) : [0, 1, 2].map((r) => moved34(own, joint, r) + translation[r]);
    // The root turns about the origin of the hand's frame, every other bone about its joint.
    for (let r = 0; r < 3; r++) {
      const row = 12 * j + 4 * r;
      for (let c = 0; c < 3; c++) transforms[row + c] = whole[3 * r + c];
      transforms[row + 3] = place[r] - moved34(whole, joint, r);
    }
  }
  return { transforms, bends };
}

const moved34 = (m, p, r) => m[3 * r] * p[0] + m[3 * r + 1] * p[1] + m[3 * r + 2] * p[2];
const moved = (t, p) => [0, 1, 2].map((r) => t[4 * r] * p[0] + t[4 * r + 1] * p[1] + t[4 * r + 2] * p[2] + t[4 * r + 3]);
const linearPart = (t) => [t[0], t[1], t[2], t[4], t[5], t[6], t[8], t[9], t[10]];

function product(a, b) {
  const out = new Float64Array(9);
  for (let r = 0; r < 3; r++) {
    for (let c = 0; c < 3; c++) out[3 * r + c] = a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c];
  }
  return out;
}

function axisRotation([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [
    x * x * k + c, x * y * k - z * s, x * z * k + y * s,
    x * y * k + z * s, y * y * k + c, y * z * k - x * s,
    x * z * k - y * s, y * z * k + x * s, z * z * k + c,
  ];
}

// Correctives, then linear blend skinning, into body.posed.
function poseSurface(body, angles) {
  const { transforms, bends } = boneTransforms(body, angles), { shaped, posed } = body;
  shaped.set(body.rest);
  body.bends.forEach(({ index, moves }, k) => {
    const strength = bends[k];
    if (strength === 0) return;
    for (let i = 0; i < index.length; i++) {
      const at = 3 * index[i];
      shaped[at] += strength * moves[3 * i];
      shaped[at + 1] += strength * moves[3 * i + 1];
      shaped[at + 2] += strength * moves[3 * i + 2];
    }
  });
  const { start, columns, values } = body.skin;
  for (let v = 0; v < body.nVertices; v++) {
    const x = shaped[3 * v], y = shaped[3 * v + 1], z = shaped[3 * v + 2];
    let px = 0, py = 0, pz = 0;
    for (let e = start[v]; e < start[v + 1]; e++) {
      const w = values[e], t = 12 * columns[e];
      px += w * (transforms[t] * x + transforms[t + 1] * y + transforms[t + 2] * z + transforms[t + 3]);
      py += w * (transforms[t + 4] * x + transforms[t + 5] * y + transforms[t + 6] * z + transforms[t + 7]);
      pz += w * (transforms[t + 8] * x + transforms[t + 9] * y + transforms[t + 10] * z + transforms[t + 11]);
    }
    posed[3 * v] = px;
    posed[3 * v + 1] = py;
    posed[3 * v + 2] = pz;
  }
}
