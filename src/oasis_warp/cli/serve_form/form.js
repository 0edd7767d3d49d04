"use strict";

// The photos that were sent from this browser: [{job, name}], newest first.
const KEY = "oasis-photos";
const PAUSE = 1000; // ms between two looks at a photo that is not done
const LINKS = [
  ["3D page", "hand.html"],
  ["summary", "summary.png"],
  ["seen and guessed skin", "quality.png"],
  ["mesh for engines (.glb)", "hand.glb"],
  ["splats (.ply)", "hand.ply"],
  ["splats (.spz)", "hand.spz"],
  ["avatar file", "avatar.safetensors"],
];

const list = document.getElementById("jobs");
const said = document.getElementById("said");
const drop = document.getElementById("drop");
const file = document.getElementById("file");

function known() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) || [];
  } catch {
    return [];
  }
}

function remember(photos) {
  localStorage.setItem(KEY, JSON.stringify(photos));
}

function card({ job, name }) {
  const item = document.getElementById("job").content.cloneNode(true).firstElementChild;
  item.querySelector("h2").textContent = name;
  watch(item, job);
  return item;
}

async function watch(item, job) {
  const state = item.querySelector(".state");
  const bar = item.querySelector("progress");
  for (;;) {
    let found;
    try {
      const answer = await fetch(`jobs/${job}`);
      if (answer.status === 404) {
        item.remove();
        remember(known().filter((photo) => photo.job !== job));
        return;
      }
      found = await answer.json();
    } catch {
      state.textContent = "The program does not answer; is it still running?";
      await new Promise((resolve) => setTimeout(resolve, 5 * PAUSE));
      continue;
    }
    bar.hidden = found.state === "done" || found.state === "failed";
    if (found.state === "waiting") state.textContent = found.ahead ? `waiting for ${found.ahead} other${found.ahead > 1 ? "s" : ""}` : "waiting";
    if (found.state === "running") state.textContent = found.note;
    if (found.state === "failed") state.textContent = `No avatar: ${found.note}`;
    if (found.state === "done") {
      show(item, job);
      return;
    }
    if (found.state === "failed") return;
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
  }
}

function show(item, job) {
  item.querySelector(".state").textContent = "";
  const video = item.querySelector("video");
  video.src = `jobs/${job}/turntable.mp4`;
  video.hidden = false;
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) video.autoplay = false;
  const links = item.querySelector(".links");
  for (const [text, name] of LINKS) {
    const link = document.createElement("a");
    link.href = `jobs/${job}/${name}`;
    link.textContent = text;
    link.target = "_blank";
    link.rel = "noopener";
    links.append(link);
  }
  links.hidden = false;
}

async function send(files) {
  for (const photo of files) {
    said.textContent = `sending ${photo.name} …`;
    try {
      const headers = { "X-Name": encodeURIComponent(photo.name) };
      const answer = await fetch("jobs", { method: "POST", body: photo, headers });
      const got = await answer.json();
      if (!answer.ok) {
        said.textContent = got.error;
        continue;
      }
      const added = { job: got.job, name: photo.name };
      remember([added, ...known()]);
      list.prepend(card(added));
      said.textContent = "";
    } catch {
      said.textContent = `${photo.name} could not be sent; is the program still running?`;
    }
  }
}

file.addEventListener("change", () => {
  send([...file.files]);
  file.value = "";
});
for (const name of ["dragenter", "dragover"]) {
  drop.addEventListener(name, (event) => {
    event.preventDefault();
    drop.classList.add("over");
  });
}
for (const name of ["dragleave", "drop"]) drop.addEventListener(name, () => drop.classList.remove("over"));
drop.addEventListener("drop", (event) => {
  event.preventDefault();
  send([...event.dataTransfer.files]);
});
list.append(...known().map(card));
