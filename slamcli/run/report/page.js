"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const unit = data.unit;
  // Pictures of the maps at full resolution, which a local server adds to the page.
  const pyramids = JSON.parse(document.getElementById("tiles").textContent);
  const style = getComputedStyle(document.documentElement);
  const colour = name => style.getPropertyValue("--" + name).trim();
  const byId = id => document.getElementById(id);

  // Texts go into the page as text alone: names of files may look like HTML.
  function element(tag, attributes = {}, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "onclick") made.addEventListener("click", value);
      else made.setAttribute(name, value);
    }
    made.append(...children.filter(child => child !== null && child !== ""));
    return made;
  }
  const coded = text => text.split("`").map((part, number) => number % 2 ? element("code", {}, part) : part);

  const frames = data.frames.map((row, index) => ({
    index, name: row[0], stamp: row[1], status: row[2], reason: row[3],
    fragment: row.length > 4 ? row[4] : -1, x: row[5], y: row[6], heading: row[7],
    sigmas: row.slice(8, 11), inliers: row[11], score: row[12], sway: row.slice(13, 16),
    sigma: row.length > 8 && row[8] !== null ? Math.hypot(row[8], row[9]) : null, links: [],
  }));
  const links = data.links.map(row => ({
    a: frames[row[0]], b: frames[row[1]], kind: row[2], off: row[3] === 1, inliers: row[4],
    score: row[5], length: row[6], angle: row[7], sigmas: row[8],
  }));
  for (const link of links) { link.a.links.push(link); link.b.links.push(link); }
  const maps = data.maps.map(one => ({
    ...one, members: frames.filter(frame => frame.fragment === one.fragment), image: null,
  }));

  // ---- numbers as texts ----
  const NAMES = { step: "step", loop: "loop closure", odometry: "odometry", partial: "along lines", compass: "compass", gps: "GPS" };
  function lengthText(value, digits = 3) {
    if (value === null || value === undefined) return "unknown";
    if (unit === "m" && Math.abs(value) < 0.1) return `${+(1000 * value).toPrecision(digits)} mm`;
    return `${Math.abs(value) < 1 ? +value.toPrecision(digits) : value.toFixed(unit === "px" ? 1 : 3)} ${unit}`;
  }
  const degrees = radians => radians * 180 / Math.PI;
  const angleText = radians => radians === null ? "unknown" : `${+degrees(radians).toPrecision(3)}°`;
  const placeText = (x, y) => `${x.toFixed(unit === "px" ? 1 : 3)}, ${y.toFixed(unit === "px" ? 1 : 3)} ${unit}`;

  // ---- colours ----
  const VIRIDIS = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121], [110, 206, 88], [181, 222, 43], [253, 231, 37]];
  function ramp(share) {
    const place = Math.min(1, Math.max(0, share)) * (VIRIDIS.length - 1), low = Math.min(VIRIDIS.length - 2, Math.floor(place));
    const mixed = VIRIDIS[low].map((v, i) => Math.round(v + (VIRIDIS[low + 1][i] - v) * (place - low)));
    return `rgb(${mixed.join(",")})`;
  }
  function range(values) {
    const sorted = values.filter(value => value !== null).sort((a, b) => a - b);
    if (!sorted.length) return null;
    const low = sorted[0], high = sorted[Math.floor(0.98 * (sorted.length - 1))];
    return [low, high > low ? high : low + Math.max(1e-9, Math.abs(low) * 1e-3)];
  }
  const SCALES = {
    score: { title: "score: probability that the pose is right", value: frame => frame.score, text: value => value.toFixed(3) },
    sigma: { title: "sigma of the position", value: frame => frame.sigma, text: value => lengthText(value, 2) },
  };
  for (const scale of Object.values(SCALES)) scale.range = range(frames.map(f => f.fragment < 0 ? null : scale.value(f)));
  let colouring = "status";
  function frameColour(frame) {
    if (frame.fragment < 0) return colour("lost");
    if (colouring === "status") return colour(frame.status);
    const { value, range: ends } = SCALES[colouring], number = value(frame);
    if (number === null || number === undefined || !ends) return "#9aa4ae";
    // Dark is good in both.
    const share = (number - ends[0]) / (ends[1] - ends[0]);
    return ramp(colouring === "score" ? 1 - share : share);
  }

  // ---- the map ----
  const canvas = byId("floor"), context = canvas.getContext("2d");
  const view = { x: 0, y: 0, scale: 1 };
  let current = maps[0] || null, selected = null, width = 0, height = 0;
  // The axes that a map is painted in may be turned, for north to be up.
  const turned = (x, y, angle) => { const c = Math.cos(angle), s = Math.sin(angle); return [c * x - s * y, s * x + c * y]; };
  const painted = (x, y) => turned(x, y, current.turn || 0);
  const unpainted = (x, y) => turned(x, y, -(current.turn || 0));
  const screen = (x, y) => {
    const [px, py] = painted(x, y);
    return [width / 2 + (px - view.x) * view.scale, height / 2 - (py - view.y) * view.scale];
  };
  function fit() {
    if (!current) return;
    let xs = [], ys = [];
    if (current.width) {
      xs.push(current.x, current.x + current.width * current.scale);
      ys.push(current.y, current.y - current.height * current.scale);
    }
    for (const frame of current.members) { const [x, y] = painted(frame.x, frame.y); xs.push(x); ys.push(y); }
    const least = values => values.reduce((a, b) => Math.min(a, b)), most = values => values.reduce((a, b) => Math.max(a, b));
    const span = [most(xs) - least(xs), most(ys) - least(ys)];
    view.x = (most(xs) + least(xs)) / 2; view.y = (most(ys) + least(ys)) / 2;
    view.scale = 0.92 * Math.min(width / (span[0] || 1), height / (span[1] || 1));
    draw();
  }
  function zoom(factor, x = width / 2, y = height / 2) {
    const px = view.x + (x - width / 2) / view.scale, py = view.y - (y - height / 2) / view.scale;
    view.scale = Math.min(1e7, Math.max(1e-4, view.scale * factor));
    view.x = px - (x - width / 2) / view.scale; view.y = py + (y - height / 2) / view.scale;
    draw();
  }
  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; paint(); });
  }
  function line(points, stroke, thickness, dash = []) {
    context.beginPath();
    points.forEach(([x, y], number) => number ? context.lineTo(x, y) : context.moveTo(x, y));
    context.strokeStyle = stroke; context.lineWidth = thickness; context.setLineDash(dash); context.stroke(); context.setLineDash([]);
  }
  function disc(x, y, radius, fill, rim = null) {
    context.beginPath(); context.arc(x, y, radius, 0, 2 * Math.PI); context.fillStyle = fill; context.fill();
    if (rim) { context.strokeStyle = rim; context.lineWidth = 1.5; context.stroke(); }
  }
  function paint() {
    const ratio = window.devicePixelRatio || 1;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = "#ececec"; context.fillRect(0, 0, width, height);
    if (!current) { context.fillStyle = colour("soft"); context.fillText("no frame has a pose", 20, 30); return; }
    if (current.image && byId("show-floor").checked) {
      const x = width / 2 + (current.x - view.x) * view.scale, y = height / 2 - (current.y - view.y) * view.scale;
      context.imageSmoothingEnabled = view.scale * current.scale < 3;
      context.drawImage(current.image, x, y, current.width * current.scale * view.scale, current.height * current.scale * view.scale);
      paintTiles();
      context.fillStyle = "rgba(255,255,255,.25)"; context.fillRect(0, 0, width, height);
    }
    if (byId("show-gps").checked) paintGps();
    if (byId("show-links").checked) paintLinks();
    paintPath();
    if (selected && selected.fragment === current.fragment) paintSelected();
    paintScaleBar();
  }
  const tiles = new Map(), MOST_TILES = 600;
  function paintTiles() {
    const one = pyramids[maps.indexOf(current)];
    if (!one) return;
    const levels = Math.max(0, Math.ceil(Math.log2(Math.max(one.width, one.height))));
    const wanted = Math.ceil(Math.log2(view.scale * one.scale * (window.devicePixelRatio || 1)));
    const level = Math.min(levels, Math.max(0, levels + wanted)), side = one.tile * 2 ** (levels - level) * one.scale;
    const left = view.x - width / 2 / view.scale, top = view.y + height / 2 / view.scale;
    const ends = (from, to, count) => [Math.max(0, Math.floor(from / side)), Math.min(Math.ceil(count * one.scale / side) - 1, Math.floor(to / side))];
    const [column0, column1] = ends(left - one.x, left - one.x + width / view.scale, one.width);
    const [row0, row1] = ends(one.y - top, one.y - top + height / view.scale, one.height);
    for (let row = row0; row <= row1; row++) for (let column = column0; column <= column1; column++) {
      const url = `${one.url}/${level}/${column}_${row}.png`;
      let image = tiles.get(url);
      if (!image) {
        if (tiles.size >= MOST_TILES) tiles.delete(tiles.keys().next().value);
        image = new Image(); image.onload = draw; image.src = url; tiles.set(url, image);
      }
      if (!image.complete || !image.naturalWidth) continue;
      const size = side / one.tile * view.scale;
      context.drawImage(image, width / 2 + (one.x + column * side - view.x) * view.scale, height / 2 - (one.y - row * side - view.y) * view.scale, image.naturalWidth * size, image.naturalHeight * size);
    }
  }
  function paintGps() {
    for (const [fragment, x, y, readX, readY, far] of data.sensors.gps) {
      if (fragment !== current.fragment) continue;
      const from = screen(x, y), to = screen(readX, readY), ink = far ? colour("off") : colour("gps");
      line([from, to], ink, 1, [2, 3]);
      line([[to[0] - 4, to[1] - 4], [to[0] + 4, to[1] + 4]], ink, 1.5); line([[to[0] - 4, to[1] + 4], [to[0] + 4, to[1] - 4]], ink, 1.5);
    }
  }
  function paintLinks() {
    for (const link of links) {
      if (link.a.fragment !== current.fragment || (link.kind === "step" && !link.off)) continue;
      const ends = [screen(link.a.x, link.a.y), screen(link.b.x, link.b.y)];
      if (link.off) line(ends, colour("off"), 1.5, [5, 4]);
      else if (link.kind === "loop") { context.globalAlpha = 0.55; line(ends, colour("loop"), 1.2); context.globalAlpha = 1; }
    }
  }
  function paintPath() {
    const placed = current.members.map(frame => ({ frame, at: screen(frame.x, frame.y), ink: frameColour(frame) }));
    for (let n = 1; n < placed.length; n++) {
      const gap = placed[n].frame.index - placed[n - 1].frame.index > 1;
      line([placed[n - 1].at, placed[n].at], "rgba(255,255,255,.85)", gap ? 3 : 6);
    }
    for (let n = 1; n < placed.length; n++) {
      const gap = placed[n].frame.index - placed[n - 1].frame.index > 1;
      line([placed[n - 1].at, placed[n].at], gap ? colour("lost") : placed[n].ink, gap ? 1.5 : 3, gap ? [3, 4] : []);
    }
    const apart = placed.length > 1 ? Math.hypot(...[0, 1].map(i => placed[0].at[i] - placed[placed.length - 1].at[i])) : 0;
    const spacing = median(placed.slice(1).map((one, n) => Math.hypot(one.at[0] - placed[n].at[0], one.at[1] - placed[n].at[1])));
    const radius = Math.max(1.5, Math.min(5, spacing / 2.5));
    for (const one of placed) disc(...one.at, radius, one.ink, radius > 3 ? "#fff" : null);
    if (placed.length) {
      context.font = "600 12px system-ui, sans-serif";
      tag("start", placed[0].at, 14);
      if (placed.length > 1) tag("end", placed[placed.length - 1].at, apart < 30 ? -14 : 14);
    }
  }
  function tag(text, [x, y], shift) {
    context.lineWidth = 4; context.strokeStyle = "rgba(255,255,255,.9)"; context.strokeText(text, x + 9, y + shift);
    context.fillStyle = colour("ink"); context.fillText(text, x + 9, y + shift);
  }
  function paintSelected() {
    const { x, y, heading } = selected, c = Math.cos(heading), s = Math.sin(heading);
    if (current.footprint.length) {
      const outline = current.footprint.map(([ahead, left]) => screen(x + c * ahead - s * left, y + s * ahead + c * left));
      line([...outline, outline[0]], "rgba(255,255,255,.9)", 4); line([...outline, outline[0]], colour("accent"), 2);
    }
    for (const link of selected.links) {
      const other = link.a === selected ? link.b : link.a;
      line([screen(x, y), screen(other.x, other.y)], link.off ? colour("off") : colour("accent"), 2, link.off ? [5, 4] : []);
    }
    const at = screen(x, y), [px, py] = painted(c, s), tip = [at[0] + 34 * px, at[1] - 34 * py];
    line([at, tip], "#fff", 6); line([at, tip], colour("ink"), 3);
    const side = [px * 8, -py * 8];
    context.beginPath(); context.moveTo(tip[0] + side[0], tip[1] + side[1]); context.lineTo(tip[0] - side[1] * .7, tip[1] + side[0] * .7); context.lineTo(tip[0] + side[1] * .7, tip[1] - side[0] * .7);
    context.closePath(); context.fillStyle = colour("ink"); context.fill();
    disc(...at, 7, frameColour(selected), colour("ink"));
  }
  function paintScaleBar() {
    const widest = 0.22 * width / view.scale, power = 10 ** Math.floor(Math.log10(widest));
    const length = power * [5, 2, 1].find(step => step * power <= widest), pixels = length * view.scale;
    const left = 16, bottom = height - 18;
    line([[left, bottom], [left + pixels, bottom]], "#fff", 7); line([[left, bottom], [left + pixels, bottom]], colour("ink"), 3);
    for (const x of [left, left + pixels]) line([[x, bottom - 5], [x, bottom + 5]], colour("ink"), 2);
    context.font = "600 12px system-ui, sans-serif";
    tag(unit === "m" && length < 0.1 ? `${+(1000 * length).toPrecision(3)} mm` : `${+length.toPrecision(3)} ${unit}`, [left - 9, bottom], -9);
  }
  function median(values) {
    const sorted = values.filter(value => value > 0).sort((a, b) => a - b);
    return sorted.length ? sorted[sorted.length >> 1] : 10;
  }

  // ---- the strip of all frames ----
  const strip = byId("timeline"), ink = strip.getContext("2d");
  function paintStrip() {
    const ratio = window.devicePixelRatio || 1, wide = strip.clientWidth, high = strip.clientHeight;
    strip.width = wide * ratio; strip.height = high * ratio;
    ink.setTransform(ratio, 0, 0, ratio, 0, 0);
    const step = wide / Math.max(1, frames.length);
    for (const frame of frames) {
      const lost = frame.fragment < 0, level = lost ? 1 : 0.72;
      ink.fillStyle = frameColour(frame);
      if (!lost && current && frame.fragment !== current.fragment) ink.globalAlpha = 0.35;
      ink.fillRect(frame.index * step, high - level * high + 4, Math.max(0.8, step > 3 ? step - 1 : step), level * high - 8);
      ink.globalAlpha = 1;
    }
    if (selected) { ink.strokeStyle = colour("ink"); ink.lineWidth = 2; ink.strokeRect(selected.index * step - 1, 1, Math.max(4, step + 1), high - 2); }
  }
  strip.addEventListener("pointerdown", event => choose(frames[Math.min(frames.length - 1, Math.floor(event.offsetX / strip.clientWidth * frames.length))]));

  // ---- one frame ----
  function choose(frame, centre = false) {
    selected = frame;
    if (frame && frame.fragment >= 0 && (!current || frame.fragment !== current.fragment)) show(maps.find(one => one.fragment === frame.fragment));
    if (centre && frame && frame.fragment >= 0) [view.x, view.y] = painted(frame.x, frame.y);
    draw(); paintStrip(); paintCard();
  }
  const chip = frame => element("button", { type: "button", class: "chip", title: `${frame.name}, frame ${frame.index}`, onclick: () => { choose(frame, true); byId("viewer").scrollIntoView({ block: "nearest" }); } }, frame.name);
  function paintCard() {
    const card = byId("card"), frame = selected;
    if (!frame) {
      card.replaceChildren(element("h2", {}, "Click a frame"), element("p", {}, "Its picture, its pose, and how well it fits the others are shown here."));
      return;
    }
    const picture = data.pictures[frame.index];
    const rows = [["frame", `${frame.index + 1} of ${frames.length}`]];
    if (frame.stamp !== null) rows.push(["stamp", `${frame.stamp} s`]);
    if (frame.fragment >= 0) {
      rows.push(["x, y", placeText(frame.x, frame.y)], ["heading", `${degrees(frame.heading).toFixed(2)}°`]);
      if (frame.sigma !== null) rows.push(["sigma x, y", `${lengthText(frame.sigmas[0], 2)}, ${lengthText(frame.sigmas[1], 2)}`], ["sigma heading", angleText(frame.sigmas[2])]);
      if (frame.inliers) rows.push(["inliers", frame.inliers]);
      if (frame.score !== null) rows.push(["score", frame.score.toFixed(4)]);
      if (frame.sway.length) rows.push(["tilt, height", `pitch ${angleText(frame.sway[0])}, roll ${angleText(frame.sway[1])}, ${lengthText(frame.sway[2], 2)}`]);
    }
    const group = data.lost.find(one => one.frames.includes(frame.index));
    card.replaceChildren(
      ...(picture ? [element("img", { src: picture, alt: `picture of frame ${frame.index}` })] : []),
      element("h2", {}, frame.name, element("span", { class: `status ${frame.status}` }, frame.status)),
      ...(frame.reason ? [element("p", { class: "reason" }, frame.reason)] : []),
      ...(group && group.remedy ? [element("p", { class: "advice" }, ...coded(group.remedy))] : []),
      element("dl", {}, ...rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, String(value))])),
      ...(frame.links.length ? [linkTable(frame)] : []),
    );
  }
  function linkTable(frame) {
    const ordered = [...frame.links].sort((a, b) => a.a.index + a.b.index - b.a.index - b.b.index);
    return element("table", { id: "links" },
      element("thead", {}, element("tr", {}, ...["linked with", "kind", "inliers", "residual"].map(name => element("th", {}, name)))),
      element("tbody", {}, ...ordered.map(link => element("tr", {},
        element("td", {}, chip(link.a === frame ? link.b : link.a)),
        element("td", { class: link.off ? "off" : "", title: link.off ? "switched off: the other links contradict it" : "" }, NAMES[link.kind] || link.kind),
        element("td", { class: "number" }, String(link.inliers || "–")),
        element("td", {}, `${lengthText(link.length, 2)}, ${angleText(link.angle)}${link.sigmas === null ? "" : ` (${link.sigmas.toFixed(1)} sigmas)`}`)))));
  }

  // ---- switches ----
  function show(one) {
    current = one; byId("map").value = String(maps.indexOf(one));
    if (one && one.picture && !one.image) {
      const image = new Image();
      image.onload = () => { one.image = image; document.body.dataset.drawn = "yes"; draw(); };
      image.src = one.picture;
    }
    fit(); paintStrip();
  }
  function paintLegend() {
    const legend = byId("legend");
    const key = (text, stroke, kind = "") => element("div", { class: "key" }, element("i", { class: kind, style: kind ? `background:${stroke}` : `border-top-color:${stroke};border-top-style:${text.includes("off") || text.includes("lost") ? "dashed" : "solid"}` }), text);
    const keys = [];
    if (colouring === "status") {
      for (const status of ["tracked", "predicted"]) if (frames.some(frame => frame.status === status)) keys.push(key(status, colour(status), "dot"));
    } else {
      const { title, range: ends, text } = SCALES[colouring];
      if (ends) {
        const stops = VIRIDIS.map((_, n) => ramp(n / (VIRIDIS.length - 1)));
        const shown = colouring === "score" ? [ends[1], ends[0]] : ends;
        keys.push(element("div", {}, title), element("div", { class: "bar", style: `background:linear-gradient(90deg,${stops.join(",")})` }), element("div", { class: "ends" }, element("span", {}, text(shown[0])), element("span", {}, text(shown[1]))));
      } else keys.push(element("div", {}, `no ${colouring} is known`));
    }
    if (frames.some(frame => frame.fragment < 0)) keys.push(key("frames lost between", colour("lost")));
    if (links.some(link => link.kind === "loop" && !link.off)) keys.push(key("loop closure", colour("loop")));
    if (links.some(link => link.off)) keys.push(key("link switched off", colour("off")));
    if (data.sensors.gps.length) keys.push(key("GPS reading", colour("gps"), "dot"));
    legend.replaceChildren(...keys);
  }
  for (const name of ["status", "score", "sigma"]) {
    byId("colours").append(element("button", { type: "button", "data-colour": name, onclick: () => recolour(name) }, name));
  }
  function recolour(name) {
    colouring = name;
    for (const button of byId("colours").children) button.setAttribute("aria-pressed", String(button.dataset.colour === name));
    paintLegend(); draw(); paintStrip();
  }

  // ---- the mouse, fingers and keys ----
  const pointers = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); pointers.set(event.pointerId, [event.offsetX, event.offsetY]); if (pointers.size === 1) moved = 0; canvas.classList.add("dragging"); });
  canvas.addEventListener("pointermove", event => {
    const here = [event.offsetX, event.offsetY], before = pointers.get(event.pointerId);
    if (before) {
      const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      moved += Math.hypot(here[0] - before[0], here[1] - before[1]);
      if (others.length) {
        const [other] = others, apart = place => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
        zoom(apart(here) / apart(before), (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
      } else { view.x -= (here[0] - before[0]) / view.scale; view.y += (here[1] - before[1]) / view.scale; draw(); }
      pointers.set(event.pointerId, here);
    }
    const place = unpainted(view.x + (here[0] - width / 2) / view.scale, view.y - (here[1] - height / 2) / view.scale);
    byId("cursor").textContent = current ? `x, y: ${placeText(...place)}` : "";
  });
  const release = event => {
    const down = pointers.delete(event.pointerId);
    if (!pointers.size) canvas.classList.remove("dragging");
    if (down && event.type === "pointerup" && moved < 5) pick(event.offsetX, event.offsetY);
  };
  canvas.addEventListener("pointerup", release); canvas.addEventListener("pointercancel", release);
  function pick(x, y) {
    if (!current) return;
    let best = null, nearest = 18;
    for (const frame of current.members) {
      const [fx, fy] = screen(frame.x, frame.y), distance = Math.hypot(fx - x, fy - y);
      if (distance < nearest) { nearest = distance; best = frame; }
    }
    choose(best);
  }
  canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY); }, { passive: false });
  canvas.addEventListener("dblclick", event => zoom(2, event.offsetX, event.offsetY));
  document.addEventListener("keydown", event => {
    if (event.target.closest("select, input") || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) choose(frames[Math.min(frames.length - 1, Math.max(0, selected ? selected.index + step : 0))]);
    else if (event.key === "+" || event.key === "=") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") fit();
    else if (event.key === "Escape") choose(null);
    else return;
    event.preventDefault();
  });
  byId("in").addEventListener("click", () => zoom(1.5));
  byId("out").addEventListener("click", () => zoom(1 / 1.5));
  byId("fit").addEventListener("click", fit);
  for (const id of ["show-links", "show-gps", "show-floor"]) byId(id).addEventListener("change", draw);
  if (!data.sensors.gps.length) byId("show-gps").parentElement.hidden = true;

  // ---- the rest of the page ----
  document.title = `${data.title}: slam report`;
  byId("title").textContent = data.title;
  byId("note").textContent = data.note;
  const KEY_FACTS = ["frames", "placed", "fragments", "path length", "area"];
  const sigmas = frames.filter(frame => frame.sigma !== null).map(frame => frame.sigma);
  for (const [name, value] of data.rows.filter(([name]) => KEY_FACTS.includes(name))) {
    const bad = name === "placed" && data.lost.length > 0;
    byId("facts").append(element("li", bad ? { class: "bad" } : {}, element("b", {}, value), element("span", {}, name === "fragments" ? "maps" : name)));
  }
  if (sigmas.length) byId("facts").append(element("li", {}, element("b", {}, lengthText(median(sigmas), 2)), element("span", {}, "median sigma of position")));
  const section = (title, wide, ...children) => byId("sections").append(element("section", { class: wide ? "section wide" : "section" }, element("h2", {}, title), ...children));
  const table = (heads, rows) => element("table", {},
    ...(heads ? [element("thead", {}, element("tr", {}, ...heads.map(head => element("th", {}, head))))] : []),
    element("tbody", {}, ...rows.map(row => element("tr", {}, ...row.map((cell, place) => place || heads ? element("td", {}, ...[cell].flat()) : element("th", {}, cell))))));
  const MOST_CHIPS = 12;
  function chips(indices) {
    const shown = element("div", { class: "chips" }, ...indices.slice(0, MOST_CHIPS).map(index => chip(frames[index])));
    if (indices.length > MOST_CHIPS) {
      const more = element("button", { type: "button", class: "chip", onclick: () => more.replaceWith(...indices.slice(MOST_CHIPS).map(index => chip(frames[index]))) }, `${indices.length - MOST_CHIPS} more`);
      shown.append(more);
    }
    return shown;
  }
  if (data.lost.length) {
    section("Lost frames, and what to try", true, table(["why", "number", "frames", "what to try"],
      data.lost.map(group => [group.reason, String(group.frames.length), chips(group.frames), coded(group.remedy)])));
  }
  const others = data.rows.filter(([name]) => !KEY_FACTS.includes(name));
  if (data.sensors.rows.length || others.length) section("Sensors and links", false, table(null, [...others, ...data.sensors.rows]));
  if (data.camera.rows.length || data.camera.lines.length) {
    const changed = data.camera.rows.some(row => row[2] !== "");
    section(changed ? "Camera: self-calibration" : "Camera", false,
      ...data.camera.lines.map(text => element("p", { class: "reason" }, text)),
      ...(data.camera.rows.length ? [table(changed ? ["", "before", "after", "sigma"] : null, data.camera.rows.map(row => changed ? row : row.slice(0, 2)))] : []));
  }
  if (data.command) section("Repeat this run", true, element("pre", { id: "command" }, data.command));
  byId("footer").textContent = `slamcli ${data.version}. poses.csv has every pose, run.toml every option, timing.toml how long it took.`;

  for (const [number, one] of maps.entries()) byId("map").append(element("option", { value: String(number) }, `${one.fragment + 1}: ${one.frames} frames`));
  if (maps.length < 2) byId("map").parentElement.hidden = true;
  byId("map").addEventListener("change", event => show(maps[Number(event.target.value)]));
  new ResizeObserver(() => {
    const first = width === 0, ratio = window.devicePixelRatio || 1;
    width = canvas.clientWidth; height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    if (first) fit(); else { waiting = false; paint(); }
    paintStrip();
  }).observe(canvas);
  recolour("status"); show(current); choose(frames[0] || null);
})();
