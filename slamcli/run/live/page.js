"use strict";
const at = id => document.getElementById(id);
const canvas = at("map"), pen = canvas.getContext("2d");
// The view: metres at the middle of the canvas, and pixels of the screen to a metre; null shows all.
let state = null, floor = null, floorGrid = null, view = null, asked = 0, marked = null;

const fixed = (value, digits) => value.toFixed(digits).replace("-", "−");

function fitted() {
  const grid = floorGrid || { x_min: -1, y_max: 1, width: 2, height: 2, scale: 1 };
  const width = grid.width * grid.scale, height = grid.height * grid.scale;
  return {
    x: grid.x_min + width / 2, y: grid.y_max - height / 2,
    zoom: 0.96 * Math.min(canvas.clientWidth / width, canvas.clientHeight / height),
  };
}

function current() {
  const found = view || fitted();
  if (at("follow").checked && state && state.pose) return { x: state.pose[0], y: state.pose[1], zoom: found.zoom };
  return found;
}

function screenOf(x, y) {
  const now = current();
  return [canvas.clientWidth / 2 + (x - now.x) * now.zoom, canvas.clientHeight / 2 - (y - now.y) * now.zoom];
}

function metresOf(column, row) {
  const now = current();
  return [now.x + (column - canvas.clientWidth / 2) / now.zoom, now.y - (row - canvas.clientHeight / 2) / now.zoom];
}

function line(points, colour, width, closed) {
  if (points.length < 2) return;
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(...screenOf(x, y));
  if (closed) pen.closePath();
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.lineJoin = "round";
  const zoom = current().zoom;
  if (floor && at("floor").checked) {
    const corner = screenOf(floorGrid.x_min, floorGrid.y_max), size = zoom * floorGrid.scale;
    pen.drawImage(floor, ...corner, floorGrid.width * size, floorGrid.height * size);
  }
  scaleBar(zoom);
  if (!state) return;
  if (at("path").checked && state.path) line(state.path, "#1f6feb", 2, false);
  if (state.ahead) line(state.ahead, "#f08c00", 1.5, true);
  if (state.pose) robot(...state.pose);
  if (marked) {
    const [column, row] = screenOf(...marked);
    pen.fillStyle = "#8e44ad";
    pen.fillRect(column - 6, row - 1, 13, 2);
    pen.fillRect(column - 1, row - 6, 2, 13);
  }
}

function robot(x, y, heading) {
  const [column, row] = screenOf(x, y);
  pen.save();
  pen.translate(column, row);
  pen.rotate(-heading);
  pen.beginPath();
  for (const point of [[13, 0], [-8, 8], [-4, 0], [-8, -8]]) pen.lineTo(...point);
  pen.closePath();
  pen.fillStyle = "#d73027";
  pen.strokeStyle = "#fff";
  pen.lineWidth = 1.5;
  pen.fill();
  pen.stroke();
  pen.restore();
}

function scaleBar(zoom) {
  if (!state || !state.unit) return;
  const wanted = 120 / zoom, power = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map(one => one * power).find(one => one <= wanted);
  const text = state.unit === "m" && length < 1 ? `${+(length * 100).toPrecision(1)} cm` : `${+length.toPrecision(1)} ${state.unit}`;
  const bottom = canvas.clientHeight - 14;
  pen.fillStyle = "#1d2733";
  pen.fillRect(14, bottom, length * zoom, 3);
  pen.font = "12px system-ui, sans-serif";
  pen.fillText(text, 14, bottom - 5);
}

function list(element, rows, tags) {
  element.replaceChildren(...rows.flatMap(([name, value]) => {
    const [first, second] = tags.map(tag => document.createElement(tag));
    first.textContent = tags[0] === "b" ? value : name;
    second.textContent = tags[0] === "b" ? name : value;
    if (tags[0] !== "b") return [first, second];
    const item = document.createElement("li");
    item.append(first, second);
    return [item];
  }));
}

function show() {
  at("mode").textContent = state.mode || "slam live";
  at("source").textContent = state.source;
  at("status").textContent = state.status;
  at("status").className = `status ${state.status}`;
  at("reason").textContent = state.reason || "";
  if (!state.frames) return;
  list(at("facts"), [
    ["frames", state.frames], ["placed", state.placed], ["frames per second", state.rate],
    ["skipped: came too fast", state.skipped], ["left out: camera stands", state.standing],
  ], ["b", "span"]);
  const rows = [];
  if (state.pose) {
    rows.push(["x", `${fixed(state.pose[0], 3)} ${state.unit}`], ["y", `${fixed(state.pose[1], 3)} ${state.unit}`]);
    rows.push(["heading", `${fixed(state.pose[2] * 180 / Math.PI, 1)}°`], ["map", state.fragment]);
  }
  if (state.sigma) rows.push(["sigma", `${state.sigma[0].toPrecision(2)} ${state.unit}, ${state.sigma[1].toPrecision(2)}°`]);
  if (state.score !== undefined) rows.push(["score", fixed(state.score, 3)]);
  list(at("pose"), rows, ["dt", "dd"]);
  if (state.map.number > asked) {
    asked = state.map.number;
    const grid = state.map, image = new Image();
    image.onload = () => { floor = image; floorGrid = grid; draw(); };
    image.src = `map.png?${asked}`;
  }
}

async function poll() {
  try {
    state = await (await fetch("state.json")).json();
    show();
    draw();
    at("picture").src = `picture.jpg?${Date.now()}`;
    setTimeout(poll, 300);
  } catch (error) {
    at("status").textContent = "ended";
    at("status").className = "status";
    at("reason").textContent = "slam live has ended; this is the last that it showed.";
  }
}

function zoomBy(factor, column, row) {
  const before = metresOf(column, row), now = current();
  view = { x: now.x, y: now.y, zoom: now.zoom * factor };
  if (!at("follow").checked) {
    const after = metresOf(column, row);
    view.x += before[0] - after[0];
    view.y += before[1] - after[1];
  }
  draw();
}

let drag = null;
canvas.addEventListener("pointerdown", event => {
  drag = { x: event.clientX, y: event.clientY, moved: false };
  canvas.setPointerCapture(event.pointerId);
});
canvas.addEventListener("pointermove", event => {
  if (!drag) return;
  const x = event.clientX - drag.x, y = event.clientY - drag.y;
  if (!drag.moved && Math.hypot(x, y) < 4) return;
  at("follow").checked = false;
  const now = current();
  view = { x: now.x - x / now.zoom, y: now.y + y / now.zoom, zoom: now.zoom };
  drag = { x: event.clientX, y: event.clientY, moved: true };
  draw();
});
canvas.addEventListener("pointerup", event => {
  if (drag && !drag.moved) {
    const box = canvas.getBoundingClientRect();
    marked = metresOf(event.clientX - box.left, event.clientY - box.top);
    at("cursor").textContent = `x ${fixed(marked[0], 3)}, y ${fixed(marked[1], 3)} ${state ? state.unit : ""}`;
    draw();
  }
  drag = null;
});
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const box = canvas.getBoundingClientRect();
  zoomBy(Math.exp(-event.deltaY / 400), event.clientX - box.left, event.clientY - box.top);
}, { passive: false });
at("in").addEventListener("click", () => zoomBy(1.5, canvas.clientWidth / 2, canvas.clientHeight / 2));
at("out").addEventListener("click", () => zoomBy(1 / 1.5, canvas.clientWidth / 2, canvas.clientHeight / 2));
at("fit").addEventListener("click", () => { view = null; at("follow").checked = false; draw(); });
for (const id of ["follow", "floor", "path"]) at(id).addEventListener("change", draw);
window.addEventListener("resize", draw);
poll();
