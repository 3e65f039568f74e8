// The maps there are, and the place where a new one is dropped.

import { all, ask, picture } from "../lib/api.js";
import { button, called, el, say } from "../lib/dom.js";
import { read } from "../edit/upload.js";

export async function show(place, { signal }) {
  const maps = await all("v1/maps", { signal });
  const cards = maps.map((map) => card(map, signal));
  place.append(el("h1", {}, "Maps"), dropZone(), el("div", { class: "grid" }, cards));
}

function card(map, signal) {
  const image = el("img", { class: "thumb", alt: "", width: 160, height: 120 });
  picture(`v1/maps/${map.id}/image.png`, { signal })
    .then((blob) => (image.src = URL.createObjectURL(blob)))
    .catch(() => {});
  const size = map.bounds.map((value) => value.toFixed(1));
  const rooms = Object.keys(map.rooms);
  return el(
    "a",
    { class: "card tile", href: `#/maps/${map.id}` },
    image,
    el("strong", {}, called(map)),
    el("small", {}, `${(size[2] - size[0]).toFixed(1)} × ${(size[3] - size[1]).toFixed(1)} m`),
    rooms.length ? el("small", {}, rooms.slice(0, 6).join(", "), rooms.length > 6 ? ", …" : "") : null,
  );
}

function dropZone() {
  const told = el("p", { class: "told", role: "alert" });
  const name = el("input", { name: "name", placeholder: "kitchen-floor", pattern: "[A-Za-z0-9][A-Za-z0-9_.\\-]*", maxlength: 64 });
  const input = el("input", { type: "file", multiple: true, accept: ".yaml,.yml,.pgm,.png,.json", hidden: true, id: "files" });
  const zone = el(
    "section",
    { class: "card drop", "aria-label": "A new map" },
    el("h2", {}, "A new map"),
    el("p", {}, "Drop files here: a ROS map (YAML with PGM or PNG), a ProcTHOR house (JSON, with its asset sizes), or an OccupancyGrid as JSON."),
    el("div", { class: "row" }, button("Choose files", () => input.click(), { class: "main" }), el("label", { class: "inline" }, "Name (if you like) ", name)),
    input,
    told,
  );
  const send = async (files) => {
    if (!files.length) return;
    told.textContent = "Reading …";
    try {
      const map = await ask("v1/maps", await read([...files], name.value.trim()));
      say("The map is there.");
      location.hash = `#/maps/${map.id}`;
    } catch (error) {
      told.textContent = error.told?.() ?? error.message;
    }
    input.value = "";
  };
  input.addEventListener("change", () => send(input.files));
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    send(event.dataTransfer.files);
  });
  return zone;
}
