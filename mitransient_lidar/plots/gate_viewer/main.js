// State of the page, its controls, and redrawing on changes.

const DASHES = ["none", "7 3", "2 3", "9 3 2 3", "none", "7 3", "2 3", "9 3 2 3"]; // of pinned pixels, at most eight
const LINK_MS = 400; // from the last change to that of the address
const PRINTED = 680; // width on paper [CSS pixels]
const [FRAME_MS, SHORTEST_MS, PLAY_MS] = [160, 40, 20000]; // duration of a gate while playing, at least, and of all gates

/** Fill in the constant parts of the page, then connect the controls. */
async function start() {
  if (!("DecompressionStream" in window)) throw new Error("this browser has no DecompressionStream");
  const stack = await loadStack();
  byId("loading").remove();
  document.querySelectorAll("main, footer").forEach((part) => (part.hidden = false));
  fillIn(stack);
  const page = new Page(stack);
  connectControls(page);
  connectImage(page);
  connectCurves(page);
  connectKeys(page);
  connectPaper(page);
  followLink(page);
  addEventListener("hashchange", () => followLink(page));
  // The image appears before the waveforms are decoded.
  await new Promise((drawn) => requestAnimationFrame(() => setTimeout(drawn)));
  await loadWaveforms(stack);
  document.querySelector("main").setAttribute("aria-busy", "false");
  page.update();
}

function fillIn(stack) {
  byId("notes").append(...stack.notes.map((note) => textElement("p", note, "note")));
  for (const name of Object.keys(stack.maps)) byId("map").append(new Option(name, name));
  for (const [name, value] of stack.attributes) {
    const row = document.createElement("tr");
    row.append(textElement("td", name), textElement("td", value));
    byId("attributes").append(row);
  }
  byId("slider").max = stack.gates - 1;
  const facts = Object.fromEntries(stack.attributes);
  const counted = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;
  const size = stack.names ? counted(stack.columns, "pixel") : `${stack.rows} × ${stack.columns} pixels`;
  const parts = [size, counted(stack.gates, stack.slice)];
  if ("pulses" in facts) parts.push(counted(Number(facts.pulses), "pulse"));
  if ("altitude" in facts) parts.push(`altitude ${facts.altitude} m`);
  if ("off_nadir_deg" in facts) parts.push(`${facts.off_nadir_deg}° off nadir`);
  byId("summary").textContent = parts.join(" · ");
  if (stack.slice === "time bin") {
    byId("view").options[0].textContent = `${stack.quantity.name} at the time`;
    byId("view").options[1].textContent = "energy at this and all later times";
    byId("range").options[0].textContent = "all times";
    if (stack.sum === null) byId("view").options[1].remove();
  } else if (stack.waveform) return;
  else byId("source").value = "gates";
  byId("source-label").hidden = true;
}

function textElement(tag, text, className = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  element.className = className;
  return element;
}

/** State of the page and its redrawing. */
class Page {
  constructor(stack) {
    this.stack = stack;
    this.image = new ImageView(stack);
    this.curves = new CurveView(stack);
    this.gate = this.brightestGate();
    this.selected = Math.floor(stack.rows / 2) * stack.columns + Math.floor(stack.columns / 2);
    this.pins = []; // { pixel, place among the styles, colour, dashes }
    this.pointed = null; // the pixel under the cursor
    this.moment = null; // the time under the cursor
    this.timer = null;
    this.waiting = false;
    this.rests = {}; // heights around the plots
    addEventListener("resize", () => (this.rests = {}));
  }

  brightestGate() {
    const { gates, pixels, gate_energy: energy } = this.stack;
    const sums = Array.from({ length: gates }, (_, k) =>
      energy.subarray(k * pixels, (k + 1) * pixels).reduce((sum, value) => sum + (value || 0), 0)
    );
    return sums.indexOf(Math.max(...sums));
  }

  /** Redraw once before the next frame, after any number of calls. */
  update() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
      if (this.timer === null) this.keepLink();
    });
  }

  draw() {
    this.drawImage();
    this.drawCurves();
    this.drawTexts();
    this.fit();
  }

  /** Keep gate and pixels in the address, which a page in a notebook has not. */
  keepLink() {
    clearTimeout(this.link);
    if (location.protocol === "about:") return;
    this.link = setTimeout(() => history.replaceState(null, "", linkOf(this)), LINK_MS);
  }

  /** Tell the style sheet what stands above and below the plots, so that they fill the window without scrolling. */
  fit() {
    const [body, main] = [document.body, document.querySelector("main")];
    const around = body.getBoundingClientRect().height - main.getBoundingClientRect().height;
    for (const name of ["image", "curves"]) {
      const plot = byId(name);
      const parts = [...plot.parentElement.children];
      const [first, last] = [parts[0], parts.findLast((part) => part.offsetHeight > 0)];
      const section = plot.parentElement.getBoundingClientRect();
      const content = last.getBoundingClientRect().bottom - section.top + (first.getBoundingClientRect().top - section.top);
      const rest = Math.ceil(around + content - plot.getBoundingClientRect().height) + 6;
      // The largest since the window's size has changed: a row that comes and goes moves nothing.
      this.rests[name] = Math.max(this.rests[name] ?? 0, rest);
      document.documentElement.style.setProperty(`--around-${name}`, `${this.rests[name]}px`);
    }
  }

  setGate(gate) {
    this.gate = Math.max(0, Math.min(this.stack.gates - 1, gate));
    this.update();
  }

  play(on) {
    clearInterval(this.timer);
    const duration = Math.max(SHORTEST_MS, Math.min(FRAME_MS, PLAY_MS / this.stack.gates));
    this.timer = on ? setInterval(() => this.setGate((this.gate + 1) % this.stack.gates), duration) : null;
    byId("play").textContent = on ? "Pause" : "Play";
    byId("caption").setAttribute("aria-live", on ? "off" : "polite");
    if (!on) this.keepLink();
    byId("play").setAttribute("aria-pressed", String(on));
  }

  pin(pixel) {
    if (this.pins.some((pin) => pin.pixel === pixel)) return this.unpin(pixel);
    const free = DASHES.findIndex((_, place) => this.pins.every((pin) => pin.place !== place));
    const { colours } = this.stack;
    if (free >= 0) this.pins.push({ pixel, place: free, colour: colours[free % colours.length], dashes: DASHES[free] });
    this.update();
  }

  unpin(pixel) {
    this.pins = this.pins.filter((pin) => pin.pixel !== pixel);
    this.update();
  }

  drawImage() {
    const view = byId("view").value;
    const isEnergy = view === "gate" || view === "sum";
    const log = isEnergy && byId("log").checked;
    this.shown = picture(this.stack, view, this.gate);
    this.image.draw(this.shown, this.range(view, log), log, this.stack.maps[byId("map").value], this.marks());
    byId("log").disabled = !isEnergy;
  }

  /** Return the range of the colours; the range of all gates is cached until an option changes. */
  range(view, log) {
    const options = { log, clip: Number(byId("clip").value), fixed: byId("range").value === "all" };
    if (!options.fixed) return colourRange(this.shown.values, options);
    const key = JSON.stringify([view, options]);
    if (this.rangeKey !== key) {
      // Depths span the gates; the energy summed from the first gate on is the largest.
      const { gate_energy, gate_depth, gate_middle } = this.stack;
      const all = { gate: () => gate_energy, sum: () => picture(this.stack, "sum", 0).values }[view];
      const span = this.stack.surface_time ? this.shown.values : gate_depth || gate_middle;
      this.fixedRange = all ? colourRange(all(), options) : extremes(span);
      this.rangeKey = key;
    }
    return this.fixedRange;
  }

  marks() {
    const marks = this.pins.map((pin) => ({ ...pin, kind: "pinned" }));
    marks.push({ pixel: this.selected, colour: "#fff", kind: "own" });
    if (this.pointed !== null) marks.push({ pixel: this.pointed, colour: "#fff", kind: "cursor" });
    return marks;
  }

  /** Return the plotted pixels: the pinned ones, the selected one, and the one under the cursor. */
  drawn() {
    const pixels = this.pins.map((pin) => ({ ...pin, kind: "pinned" }));
    const add = (pixel, kind) => {
      if (pixel !== null && pixels.every((other) => other.pixel !== pixel)) pixels.push({ pixel, kind, colour: null });
    };
    add(this.selected, "own");
    add(this.pointed, "preview");
    return pixels;
  }

  drawCurves() {
    const source = this.stack.waveform?.power ? byId("source").value : "gates";
    this.records = this.drawn().map((pixel) => ({ ...pixel, ...record(this.stack, source, pixel.pixel) }));
    byId("whole-label").hidden = source === "gates";
    const options = { gate: this.gate, log: byId("curve-log").checked, whole: byId("whole").checked, moment: this.moment };
    this.curves.draw(this.records, options);
  }

  drawTexts() {
    byId("slider").value = this.gate;
    byId("slider").setAttribute("aria-valuetext", this.gateText());
    byId("number").textContent = `${this.gate} / ${this.stack.gates - 1}`;
    byId("caption").textContent = this.gateText(byId("view").value === "gate" ? "" : "From ");
    const pixel = this.pointed ?? this.selected;
    const error = this.shown.errors && this.shown.errors[pixel];
    const value = withUnit(this.shown.values[pixel], this.shown.unit, error);
    byId("reading").textContent = `${describePixel(this.stack, pixel)}: ${value}`;
    const pinned = this.pins.some((pin) => pin.pixel === this.selected);
    byId("pin").textContent = pinned ? "Unpin pixel" : "Pin pixel";
    byId("pin").disabled = !pinned && this.pins.length === DASHES.length;
    this.drawList();
  }

  gateText(before = "") {
    const slice = before + this.stack.slice;
    const name = slice[0].toUpperCase() + slice.slice(1);
    const { gate_start: start, gate_width: width, gate_depth: depth } = this.stack;
    const times = `${plain(start[this.gate], 2)} to ${plain(start[this.gate] + width[this.gate], 2)} ns`;
    return `${name} ${this.gate} · ${times}` + (depth ? ` · ${this.stack.depth_name} ${plain(depth[this.gate], 2)} m` : "");
  }

  /** List the plotted pixels with their values at the time under the cursor, or else in the gate. */
  drawList() {
    const time = this.moment ?? this.stack.gate_middle[this.gate];
    const depth = depthAt(this.stack, time);
    byId("moment").textContent = `At ${plain(time, 2)} ns` + (depth === null ? ":" : `, ${this.stack.depth_name} ${plain(depth, 2)} m:`);
    byId("list").replaceChildren(...this.records.map((entry) => this.listEntry(entry, time)));
    byId("hint").hidden = this.pins.length > 0;
  }

  listEntry({ pixel, colour, dashes, kind, x, y, error, unit }, time) {
    const nearest = x.reduce((best, other, i) => (Math.abs(other - time) < Math.abs(x[best] - time) ? i : best), 0);
    const entry = document.createElement("li");
    const line = svg("path", { d: "M0 6h26", stroke: colour || "currentColor", "stroke-width": 2.5, "stroke-dasharray": dashes || "none" });
    const swatch = svg("svg", { class: "swatch", "aria-hidden": "true" }, line);
    if (kind === "preview") swatch.style.opacity = "0.5";
    const value = textElement("span", withUnit(y[nearest], unit, error && error[nearest]), "value");
    entry.append(swatch, textElement("span", describePixel(this.stack, pixel), "who"), value);
    if (kind === "pinned") {
      const remove = textElement("button", "×");
      remove.type = "button";
      remove.setAttribute("aria-label", `Unpin ${describePixel(this.stack, pixel)}`);
      remove.addEventListener("click", () => this.unpin(pixel));
      entry.append(remove);
    }
    return entry;
  }
}

function connectControls(page) {
  for (const id of ["view", "map", "range", "clip", "log", "source", "curve-log", "whole"]) {
    byId(id).addEventListener("change", () => page.update());
  }
  byId("slider").addEventListener("input", () => page.setGate(Number(byId("slider").value)));
  const buttons = {
    back: () => page.setGate(page.gate - 1),
    forward: () => page.setGate(page.gate + 1),
    play: () => page.play(page.timer === null),
    pin: () => page.pin(page.selected),
    "zoom-in": () => page.image.zoomBy(2),
    "zoom-out": () => page.image.zoomBy(0.5),
    "zoom-reset": () => page.image.reset(),
    "save-csv": () => save(recordsAsCsv(page.stack, page.records), "text/csv", `${document.title}.csv`),
    "save-png": async () => save(await pictureAsPng(`${page.stack.title} · ${page.gateText()}`), "image/png", `${document.title}.png`),
  };
  for (const [id, act] of Object.entries(buttons)) {
    byId(id).addEventListener("click", () => {
      act();
      page.update();
    });
  }
  const resized = new ResizeObserver(() => page.update());
  for (const id of ["image", "curves"]) resized.observe(byId(id));
}

/** Clicks and taps select pixels, drags move the image, wheel and pinch zoom. */
function connectImage(page) {
  const { canvas } = page.image;
  const pointers = new Map(); // last position of each that is down
  let moved = false; // since the first one has gone down
  const show = (pixel) => {
    page.pointed = pixel;
    page.update();
  };
  const middle = (places) => [0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
  const spread = (places) => (places.length < 2 ? 1 : Math.hypot(places[0][0] - places[1][0], places[0][1] - places[1][1]));
  canvas.addEventListener("pointerdown", (event) => {
    document.documentElement.classList.toggle("touched", event.pointerType === "touch");
    moved = pointers.size > 0;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (pointers.size < 2) show(page.image.pixelAt(event));
    if (!pointers.has(event.pointerId)) return;
    const before = [...pointers.values()];
    const place = [event.clientX, event.clientY];
    if (!moved && Math.hypot(place[0] - before[0][0], place[1] - before[0][1]) < 5) return;
    moved = true;
    canvas.classList.add("dragged");
    pointers.set(event.pointerId, place);
    const after = [...pointers.values()];
    const box = canvas.getBoundingClientRect();
    const [from, to] = [middle(before), middle(after)];
    page.image.zoomBy(spread(after) / Math.max(spread(before), 1), (from[0] - box.left) / box.width, (from[1] - box.top) / box.height);
    page.image.moveBy((from[0] - to[0]) / box.width, (from[1] - to[1]) / box.height);
    page.update();
  });
  // Else the browser would take two fingers for its own.
  canvas.addEventListener("touchstart", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });
  canvas.addEventListener("pointerup", (event) => {
    if (!moved && pointers.has(event.pointerId)) {
      page.selected = page.image.pixelAt(event) ?? page.selected;
      if (event.shiftKey) page.pin(page.selected);
      page.update();
    }
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      pointers.delete(event.pointerId);
      canvas.classList.remove("dragged");
    });
  }
  canvas.addEventListener("pointerleave", () => show(null));
  canvas.addEventListener("blur", () => show(null));
  const zoom = (event) => {
    event.preventDefault();
    const box = canvas.getBoundingClientRect();
    const place = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    page.image.zoomBy(Math.exp(-0.002 * event.deltaY), ...place);
    page.update();
  };
  canvas.addEventListener("wheel", zoom, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const { rows, columns } = page.stack;
    const pixel = page.pointed ?? page.selected;
    const [row, column] = [Math.floor(pixel / columns), pixel % columns];
    const step = event.shiftKey ? 10 : 1;
    const to = (r, c) => Math.max(0, Math.min(rows - 1, r)) * columns + Math.max(0, Math.min(columns - 1, c));
    const acts = {
      ArrowLeft: () => show(to(row, column - step)),
      ArrowRight: () => show(to(row, column + step)),
      ArrowUp: () => show(to(row - step, column)),
      ArrowDown: () => show(to(row + step, column)),
      Enter: () => ((page.selected = pixel), page.update()),
    };
    if (!(event.key in acts)) return;
    event.preventDefault();
    event.stopPropagation();
    acts[event.key]();
  });
}

function connectCurves(page) {
  const { plot } = page.curves;
  plot.addEventListener("pointermove", (event) => {
    page.moment = page.curves.timeAt(event);
    page.update();
  });
  plot.addEventListener("pointerleave", () => {
    page.moment = null;
    page.update();
  });
  // No click: a redrawing between press and release would swallow it.
  plot.addEventListener("pointerup", (event) => {
    const time = page.curves.timeAt(event);
    const distances = page.stack.gate_middle.map((middle) => Math.abs(middle - time));
    page.setGate(distances.indexOf(Math.min(...distances)));
  });
}

/** Draw for the width of paper while the page is printed. */
function connectPaper(page) {
  const draw = (width) => {
    document.body.style.width = width;
    page.rests = {};
    page.draw();
  };
  addEventListener("beforeprint", () => draw(`${PRINTED}px`));
  addEventListener("afterprint", () => draw(""));
}

/** Keys of the page, except while a control uses them itself. */
function connectKeys(page) {
  const acts = {
    ArrowLeft: () => page.setGate(page.gate - 1),
    ArrowRight: () => page.setGate(page.gate + 1),
    Home: () => page.setGate(0),
    End: () => page.setGate(page.stack.gates - 1),
    " ": () => page.play(page.timer === null),
    p: () => page.pin(page.pointed ?? page.selected),
    "+": () => page.image.zoomBy(2),
    "-": () => page.image.zoomBy(0.5),
    0: () => page.image.reset(),
    "?": () => {
      byId("help").open = !byId("help").open;
      byId("help").scrollIntoView({ block: "nearest" });
    },
  };
  document.addEventListener("keydown", (event) => {
    if (!(event.key in acts) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("select, input[type=range], summary")) return;
    if (event.key === " " && event.target.closest("button, input")) return;
    event.preventDefault();
    acts[event.key]();
    page.update();
  });
}

start().catch((error) => {
  byId("loading")?.remove();
  byId("notes").append(textElement("p", `The page cannot be shown: ${error.message}.`, "note"));
  throw error;
});
