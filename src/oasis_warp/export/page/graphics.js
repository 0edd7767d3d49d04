// Draw ellipses on the graphics card with WebGL 2: one quad each, blended from the farthest to the nearest.
"use strict";

const VERTEX = `#version 300 es
precision highp float;
uniform vec2 size;
layout(location = 0) in vec2 corner;
layout(location = 1) in vec2 centre;
layout(location = 2) in vec3 axes;  // the longer axis; the shorter one is this share of it, turned by 90 degrees
layout(location = 3) in vec4 color;
out vec2 place;
flat out vec4 skin;
void main() {
  float reach = min(3.33, sqrt(2. * log(max(255. * color.a, 1.))));
  place = corner * reach;
  skin = color;
  vec2 at = centre + place.x * axes.xy + place.y * axes.z * vec2(-axes.y, axes.x);
  gl_Position = vec4(2. * at.x / size.x - 1., 1. - 2. * at.y / size.y, 0, 1);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 skin;
out vec4 drawn;
void main() {
  float alpha = min(.999, skin.a * exp(-.5 * dot(place, place)));
  if (alpha < 1. / 255.) discard;
  drawn = vec4(skin.rgb * alpha, alpha);
}`;

const openGraphics = (canvas) =>
  canvas.getContext("webgl2", { antialias: false, alpha: true, premultipliedAlpha: true, depth: false });

// The function that draws. What the graphics card forgets, as in a sleep of the machine, is set up again.
function makeGraphics(canvas) {
  let parts = setUpGraphics(canvas);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    parts = setUpGraphics(canvas);
    canvas.dispatchEvent(new Event("forgotten"));
  });
  return async ({ ellipses, count }, width, height) => {
    const { gl, size } = parts;
    sizeCanvas(canvas, width, height);
    gl.viewport(0, 0, width, height);
    gl.uniform2f(size, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bufferData(gl.ARRAY_BUFFER, ellipses, gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  };
}

function setUpGraphics(canvas) {
  const gl = openGraphics(canvas), program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  for (const [place, size, type, offset] of [[1, 2, gl.FLOAT, 0], [2, 3, gl.FLOAT, 8], [3, 4, gl.UNSIGNED_BYTE, 20]]) {
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, type === gl.UNSIGNED_BYTE, 24, offset);
    gl.vertexAttribDivisor(place, 1);
  }
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.clearColor(0, 0, 0, 0);
  return { gl, size: gl.getUniformLocation(program, "size") };
}

function sizeCanvas(canvas, width, height) {
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
}

// Whether there is a graphics card: without one browsers draw with WebGL too, but ten times slower than raster.js.
function hasGraphicsCard() {
  const gl = openGraphics(document.createElement("canvas"));
  if (!gl) return false;
  let name = gl.getParameter(gl.RENDERER);
  const info = /webkit|mozilla/i.test(name) && gl.getExtension("WEBGL_debug_renderer_info");
  if (info) name = gl.getParameter(info.UNMASKED_RENDERER_WEBGL);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|software|basic render/i.test(name);
}
