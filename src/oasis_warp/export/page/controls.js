// The panel: named poses, motions, light, views and joints.
"use strict";

const EASE = 350; // ms from one named pose to the next
const LABELS = { photo: "Photo", even: "Even", studio: "Studio", map: "Invented skin" };

const byId = (id) => document.getElementById(id);
const degrees = (radians) => `${Math.round((radians * 180) / Math.PI)}°`;

function make(tag, properties, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function fillPanel(viewer) {
  const { facts } = viewer;
  const kind = { left: "Left hand, ", right: "Right hand, " }[facts.side] ?? "";
  byId("facts").textContent = `${kind}${facts.count.toLocaleString("en")} Gaussians`;
  if (!facts.side) for (const part of ["pose", "look", "joints"]) byId(`${part}-title`).parentElement.hidden = true;
  const player = { viewer, playing: false, time: 0, last: 0, ease: null, sliders: [], chips: new Map() };
  for (const pose of facts.poses) {
    const chip = make("button", { type: "button", textContent: pose.label, onclick: () => changePose(player, pose) });
    player.chips.set(pose.name, chip);
    byId("poses").append(chip);
  }
  markPose(player, facts.start.pose);
  fillMotion(player);
  if (facts.side) fillLooks(viewer);
  fillJoints(player);
  fillViews(viewer);
  viewer.tick = (now) => advance(player, now);
  return player;
}

function markPose({ chips }, name) {
  for (const [of, chip] of chips) chip.setAttribute("aria-pressed", String(of === name));
}

// Ease to a pose, and move the view to its middle.
function changePose(player, { name, angles, target }) {
  stop(player);
  markPose(player, name);
  easeTo(player, angles, target);
}

function easeTo(player, angles, target) {
  const { viewer } = player, start = performance.now();
  const span = matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : EASE;
  player.ease = { from: viewer.angles.slice(), to: angles ?? viewer.angles.slice(), away: viewer.camera.target, target, start, span };
  show(viewer, true);
}

function setAngles(player, angles, moving = false) {
  player.viewer.angles.set(angles);
  for (const { input, output, index, rest } of player.sliders) {
    input.value = angles[index];
    output.textContent = degrees(angles[index] + rest);
  }
  show(player.viewer, moving);
}

const mix = (a, b, share) => a.map((x, k) => x + share * (b[k] - x));

// Before each picture: ease towards a pose, or play on.
function advance(player, now) {
  if (player.ease) {
    const { from, to, away, target, start, span } = player.ease, share = span ? Math.min((now - start) / span, 1) : 1;
    const blend = 0.5 - 0.5 * Math.cos(Math.PI * share);
    player.viewer.camera.target = mix(away, target, blend);
    setAngles(player, mix(from, to, blend), true);
    if (share === 1) player.ease = null;
  }
  if (!player.playing || player.viewer.waiting > 1) return; // no faster than pictures come
  const motion = player.motions[byId("motion").selectedIndex];
  player.time = (player.time + ((now - player.last) / 1000) * Number(byId("speed").value) / motion.seconds) % 1;
  player.last = now;
  showTime(player);
}

// Show the motion at player.time, a share of it.
function showTime(player) {
  const motion = player.motions[byId("motion").selectedIndex];
  byId("time").value = player.time;
  byId("time-value").textContent = `${Math.round(100 * player.time)} %`;
  if (!motion.frames) {
    player.viewer.camera.azimuth = player.from + 2 * Math.PI * player.time;
    return show(player.viewer, true);
  }
  player.viewer.camera.target = player.viewer.facts.frame.target; // the middle of all poses
  const at = player.time * motion.frames.length, first = Math.floor(at) % motion.frames.length;
  markPose(player, null);
  setAngles(player, mix(motion.frames[first], motion.frames[(first + 1) % motion.frames.length], at - Math.floor(at)), true);
}

function stop(player) {
  Object.assign(player, { playing: false, ease: null });
  byId("play").textContent = "Play";
  byId("play").setAttribute("aria-pressed", "false");
}

function fillMotion(player) {
  player.motions = [...player.viewer.facts.motions, { label: "Turn around", seconds: 6 }];
  byId("motion").append(...player.motions.map(({ label }) => make("option", { textContent: label })));
  byId("motion").onchange = () => Object.assign(player, { time: 0, from: player.viewer.camera.azimuth });
  byId("play").onclick = () => {
    if (player.playing) return stop(player);
    player.from = player.viewer.camera.azimuth - 2 * Math.PI * player.time;
    Object.assign(player, { playing: true, ease: null, last: performance.now() });
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
  };
  byId("time").oninput = () => {
    stop(player);
    player.from ??= player.viewer.camera.azimuth;
    player.time = Math.min(Number(byId("time").value), 0.999);
    showTime(player);
  };
  byId("speed").oninput = () => (byId("speed-value").textContent = `${byId("speed").value} ×`);
}

function fillLooks(viewer) {
  const { facts } = viewer, looks = [...Object.keys(facts.lights), "even", ...(facts.hasInvented ? ["map"] : [])];
  const buttons = looks.map((look) => make("button", { type: "button", textContent: LABELS[look], onclick: () => choose(look) }));
  const choose = (look) => {
    viewer.look = look;
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(looks[k] === look)));
    byId("look-note").replaceChildren(...noteOn(look, facts));
    show(viewer);
  };
  byId("looks").append(...buttons);
  choose(viewer.look);
}

function noteOn(look, facts) {
  if (look === "map") {
    const swatch = (kind) => make("span", { className: `swatch ${kind}` });
    return [swatch("seen"), "seen in a photo", swatch("invented"), "inpainted"];
  }
  if (look === "even") return [facts.lights.photo ? "Even light, without the light of the photo." : "Light and shadows of the photo are part of the skin."];
  return [{ photo: "The photo's own light, with the shadows that the hand casts on itself.", studio: "Three large lamps." }[look]];
}

function fillJoints(player) {
  for (const { finger, joints } of player.viewer.facts.joints) {
    const group = make("details", {}, make("summary", { textContent: finger }));
    for (const { label, index, low, high, rest } of joints) {
      const input = make("input", { type: "range", min: low, max: high, step: 0.01, value: player.viewer.angles[index] });
      const output = make("output", { textContent: degrees(player.viewer.angles[index] + rest) });
      input.setAttribute("aria-label", `${finger}, ${label}`);
      input.oninput = () => {
        stop(player);
        markPose(player, null);
        player.viewer.angles[index] = Number(input.value);
        output.textContent = degrees(player.viewer.angles[index] + rest);
        show(player.viewer, true);
      };
      player.sliders.push({ input, output, index, rest });
      group.append(make("label", { className: "slider" }, make("span", { textContent: label }), input, output));
    }
    byId("joints").append(group);
  }
}

function fillViews(viewer) {
  if (!viewer.facts.side) byId("front").textContent = "Front";
  byId("front").onclick = () => goHome(viewer, 0);
  byId("back").onclick = () => goHome(viewer, Math.PI);
  byId("save").onclick = async () => {
    const blob = await takePicture(viewer), link = make("a", { href: URL.createObjectURL(blob), download: "hand.png" });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  };
  const photo = byId("photo"), compare = byId("compare");
  compare.hidden = !photo;
  compare.onclick = () => {
    photo.hidden = !photo.hidden;
    compare.setAttribute("aria-pressed", String(!photo.hidden));
  };
  byId("fold").onclick = () => {
    const folded = byId("panel").classList.toggle("folded");
    byId("fold").textContent = folded ? "More" : "Less";
    byId("fold").setAttribute("aria-expanded", String(!folded));
  };
}
