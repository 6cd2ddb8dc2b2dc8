// The image of a gate, its axes and its colour bar.

const MARGIN = { left: 58, right: 92, top: 6, bottom: 40 };
const LARGEST_ZOOM = 64;
const SHAPE_ZOOM = 16; // largest one of pixels with outlines
const NAMED = 12; // most pixels whose names are drawn in their outlines

/** Return an SVG element with children. */
function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Return round numbers between two limits, and their number of decimals. */
function linearTicks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-6); i * step <= high + 1e-6 * step; i++) ticks.push(i * step);
  return { ticks, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

/** Return powers of ten between two limits, with multiples of 2 and 5 if there are few. */
function logTicks(low, high) {
  const decades = Math.log10(high / low);
  const factors = decades < 1.5 ? [1, 2, 5] : [1];
  const skip = Math.ceil(decades / 7);
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++) {
    if (power % skip) continue;
    for (const factor of factors) {
      const tick = factor * 10 ** power;
      if (tick >= low * 0.999 && tick <= high * 1.001) ticks.push(tick);
    }
  }
  return ticks;
}

/** Return the text of a logarithmic tick, as a power of ten if small or large. */
function logText(tick) {
  const power = Math.log10(tick);
  if (Math.abs(power) < 2.5) return String(+tick.toPrecision(6));
  return `10${[...String(Math.round(power))].map((sign) => (sign === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[sign])).join("")}`;
}

/** Return ticks, their texts in a unit with an SI prefix, and the prefix. */
function tickLabels(low, high, log, count, unit) {
  const { factor, sign } = ["J", "W", "V"].includes(unit) ? prefix(high) : { factor: 1, sign: "" };
  if (log) {
    const ticks = logTicks(low / factor, high / factor);
    return { ticks: ticks.map((tick) => tick * factor), texts: ticks.map(logText), sign };
  }
  const { ticks, digits } = linearTicks(low / factor, high / factor, count);
  return { ticks: ticks.map((tick) => tick * factor), texts: ticks.map((tick) => plain(tick, digits)), sign };
}

/** View of the image: visible part and drawing. */
class ImageView {
  constructor(stack) {
    this.stack = stack;
    this.plot = document.getElementById("image");
    this.canvas = document.getElementById("pixels");
    this.bar = document.getElementById("bar");
    this.axes = document.getElementById("image-axes");
    this.whole = document.createElement("canvas"); // the full image, one dot a pixel
    this.whole.width = stack.columns;
    this.whole.height = stack.rows;
    this.shapes = stack.shapes && stack.shapes.map((lines) => this.shape(lines));
    this.reset();
  }

  /** Return the outline of a pixel as a path, whose unit is the width of a column and the height of the row. */
  shape(lines) {
    const { left, top, across, along } = this.stack.axes;
    const path = new Path2D();
    for (const line of lines) {
      for (let i = 0; i < line.length; i += 2) path.lineTo((line[i + 1] - left) / across, (top - line[i]) / along);
      path.closePath();
    }
    return path;
  }

  reset() {
    this.zoom = 1;
    this.left = 0; // in columns
    this.top = 0; // in rows
  }

  /** Zoom about a place, given in shares of the visible width and height. */
  zoomBy(factor, across = 0.5, along = 0.5) {
    const { rows, columns } = this.stack;
    const most = this.stack.shapes ? SHAPE_ZOOM : Math.max(1, Math.min(LARGEST_ZOOM, Math.max(rows, columns) / 4));
    const zoom = Math.max(1, Math.min(most, this.zoom * factor));
    this.left += across * columns * (1 / this.zoom - 1 / zoom);
    this.top += along * rows * (1 / this.zoom - 1 / zoom);
    this.zoom = zoom;
    this.moveBy(0, 0);
  }

  /** Move the visible part by shares of its width and height, within the image. */
  moveBy(across, along) {
    const { rows, columns } = this.stack;
    const within = (value, room) => Math.max(0, Math.min(room, value));
    this.left = within(this.left + (across * columns) / this.zoom, columns * (1 - 1 / this.zoom));
    this.top = within(this.top + (along * rows) / this.zoom, rows * (1 - 1 / this.zoom));
  }

  /** Return the index of the pixel at the position of a pointer event, null beside all outlines. */
  pixelAt(event) {
    const { rows, columns } = this.stack;
    const box = this.canvas.getBoundingClientRect();
    const across = this.left + ((event.clientX - box.left) / box.width) * (columns / this.zoom);
    const along = this.top + ((event.clientY - box.top) / box.height) * (rows / this.zoom);
    if (this.shapes) {
      const context = this.whole.getContext("2d");
      const found = this.shapes.findIndex((path) => context.isPointInPath(path, across, along, "evenodd"));
      return found < 0 ? null : found;
    }
    const [column, row] = [Math.floor(across), Math.floor(along)];
    return Math.max(0, Math.min(rows - 1, row)) * columns + Math.max(0, Math.min(columns - 1, column));
  }

  /** Fit the drawing into its box, with the proportions of the image. */
  layOut() {
    const { rows, columns, axes } = this.stack;
    this.canvas.classList.toggle("zoomed", this.zoom > 1);
    this.plot.style.height = ""; // the height of the style sheet is the largest
    const box = this.plot.getBoundingClientRect();
    const room = [box.width - MARGIN.left - MARGIN.right, box.height - MARGIN.top - MARGIN.bottom];
    const across = columns * Math.abs(axes.across);
    const scale = Math.min(room[0] / across, room[1] / (rows * axes.along));
    this.width = Math.max(1, Math.round(scale * across));
    this.height = Math.max(1, Math.round(scale * rows * axes.along));
    this.x = MARGIN.left + Math.round((room[0] - this.width) / 2);
    this.plot.style.height = `${this.height + MARGIN.top + MARGIN.bottom}px`;
    const dots = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.width * dots);
    this.canvas.height = Math.round(this.height * dots);
    const place = (element, left, width, height) =>
      Object.assign(element.style, {
        left: `${left}px`, top: `${MARGIN.top}px`, width: `${width}px`, height: `${height}px`,
      });
    place(this.canvas, this.x, this.width, this.height);
    place(this.bar, this.x + this.width + 12, 14, this.height);
  }

  /** Draw values with a colour map over a range; pixels without a value are blank. */
  draw(shown, range, log, map, marks) {
    this.layOut();
    const [low, high] = log ? range.map(Math.log) : range;
    const dots = new ImageData(this.stack.columns, this.stack.rows);
    shown.values.forEach((value, i) => {
      if (Number.isNaN(value)) return;
      const share = ((log ? Math.log(Math.max(value, 0)) : value) - low) / (high - low);
      const index = 3 * Math.max(0, Math.min(255, Math.floor(256 * share)));
      dots.data.set([map[index], map[index + 1], map[index + 2], 255], 4 * i);
    });
    const context = this.canvas.getContext("2d");
    const seen = [this.stack.columns / this.zoom, this.stack.rows / this.zoom];
    if (this.shapes) {
      context.scale(this.canvas.width / seen[0], this.canvas.height / seen[1]);
      context.translate(-this.left, -this.top);
      this.shapes.forEach((path, i) => {
        const [red, green, blue, opaque] = dots.data.subarray(4 * i, 4 * i + 4);
        context.fillStyle = `rgb(${red} ${green} ${blue} / ${opaque / 255})`;
        context.fill(path, "evenodd");
      });
    } else {
      this.whole.getContext("2d").putImageData(dots, 0, 0);
      context.imageSmoothingEnabled = false;
      context.drawImage(this.whole, this.left, this.top, ...seen, 0, 0, this.canvas.width, this.canvas.height);
    }
    this.drawBar(map);
    this.axes.replaceChildren(
      ...this.imageAxes(), ...this.barAxis(range, log, shown), ...marks.map((mark) => this.mark(mark))
    );
  }

  drawBar(map) {
    const dots = new ImageData(1, 256);
    for (let i = 0; i < 256; i++) dots.data.set([...map.subarray(3 * i, 3 * i + 3), 255], 4 * (255 - i));
    this.bar.getContext("2d").putImageData(dots, 0, 0);
  }

  imageAxes() {
    const { axes, names, columns } = this.stack;
    const [bottom, zoom] = [MARGIN.top + this.height, this.zoom];
    const scale = [this.width / (columns * axes.across), this.height / (this.stack.rows * axes.along)].map((s) => s * zoom);
    const x = (angle) => this.x + (angle - axes.left - this.left * axes.across) * scale[0];
    const y = (angle) => MARGIN.top + (axes.top - this.top * axes.along - angle) * scale[1];
    const seen = [x, y].map((to, i) => (angle) => {
      const [start, length] = i ? [MARGIN.top, this.height] : [this.x, this.width];
      return to(angle) >= start - 0.5 && to(angle) <= start + length + 0.5;
    });
    const elements = [];
    // angle_y falls to the right.
    const ends = [this.left, this.left + columns / zoom].map((column) => axes.left + column * axes.across);
    const across = linearTicks(Math.min(...ends), Math.max(...ends), this.width / 70);
    const isStrip = names && !this.shapes;
    if (isStrip) Object.assign(across, { ticks: across.ticks.filter(Number.isInteger), digits: 0 });
    for (const tick of across.ticks.filter(seen[0])) {
      elements.push(
        svg("path", { class: "axis", d: `M${x(tick)} ${bottom}v5` }),
        svg("text", { x: x(tick), y: bottom + 18, "text-anchor": "middle" }, isStrip ? names[tick] : plain(tick, across.digits))
      );
    }
    const middle = this.x + this.width / 2;
    const across_name = isStrip ? "pixel" : "to the left, angle_y (mrad)";
    elements.push(svg("text", { class: "name", x: middle, y: bottom + 35, "text-anchor": "middle" }, across_name));
    if (isStrip) return elements;
    if (this.shapes && names.length <= NAMED) {
      this.stack.shapes.forEach((lines, pixel) => {
        const limits = lines.map((line) => [0, 1].map((axis) => extremes(line.filter((_, i) => i % 2 === axis))));
        const [along, across] = limits[0];
        // Of a pixel with a hole, between the upper edges of both.
        const height = limits.length > 1 ? (along[1] + limits[1][0][1]) / 2 : (along[0] + along[1]) / 2;
        const place = { x: x((across[0] + across[1]) / 2), y: y(height) + 4, "text-anchor": "middle" };
        elements.push(svg("text", { class: "pixel-name", ...place }, names[pixel]));
      });
    }
    const upper = axes.top - this.top * axes.along;
    const along = linearTicks(upper - (this.stack.rows / zoom) * axes.along, upper, this.height / 50);
    for (const tick of along.ticks.filter(seen[1])) {
      elements.push(
        svg("path", { class: "axis", d: `M${this.x} ${y(tick)}h-5` }),
        svg("text", { x: this.x - 8, y: y(tick) + 4, "text-anchor": "end" }, plain(tick, along.digits))
      );
    }
    const turn = `translate(${this.x - 44} ${MARGIN.top + this.height / 2}) rotate(-90)`;
    elements.push(svg("text", { class: "name", transform: turn, "text-anchor": "middle" }, "away from nadir, angle_x (mrad)"));
    return elements;
  }

  barAxis([low, high], log, shown) {
    const { ticks, texts, sign } = tickLabels(low, high, log, this.height / 45, shown.unit);
    const share = (value) => (log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));
    const right = this.x + this.width + 26;
    const elements = ticks.flatMap((tick, i) => {
      const y = MARGIN.top + (1 - share(tick)) * this.height;
      return [
        svg("path", { class: "axis", d: `M${right} ${y}h4` }),
        svg("text", { class: "bar-tick", x: right + 7, y: y + 4 }, texts[i]),
      ];
    });
    const name = `${shown.name} (${sign}${shown.unit})`;
    const turn = `translate(${right + 54} ${MARGIN.top + this.height / 2}) rotate(-90)`;
    elements.push(svg("text", { class: "name", transform: turn, "text-anchor": "middle" }, name));
    return elements;
  }

  /** Return the frame of a pixel { pixel, colour, kind }, its outline, or a square at least a few dots wide. */
  mark({ pixel, colour, kind }) {
    const { rows, columns, axes, shapes } = this.stack;
    if (shapes) {
      const scale = [(this.width / columns) * this.zoom, (this.height / rows) * this.zoom];
      const x = (angle) => this.x + ((angle - axes.left) / axes.across - this.left) * scale[0];
      const y = (angle) => MARGIN.top + ((axes.top - angle) / axes.along - this.top) * scale[1];
      const line = (points) => {
        const corners = Array.from({ length: points.length / 2 }, (_, i) => `${x(points[2 * i + 1])} ${y(points[2 * i])}`);
        return `M${corners.join("L")}Z`;
      };
      const box = { x: this.x, y: MARGIN.top, width: this.width, height: this.height };
      const clip = svg("clipPath", { id: `seen-${kind}-${pixel}` }, svg("rect", box));
      const outline = { d: shapes[pixel].map(line).join(""), "clip-path": `url(#seen-${kind}-${pixel})` };
      return svg("g", {}, clip, svg("path", { class: "halo", ...outline }), svg("path", { class: `mark ${kind}`, stroke: colour, ...outline }));
    }
    const size = [(this.width / columns) * this.zoom, (this.height / rows) * this.zoom];
    const middle = [
      ((pixel % columns) + 0.5 - this.left) * size[0],
      (Math.floor(pixel / columns) + 0.5 - this.top) * size[1],
    ];
    if (middle[0] < 0 || middle[1] < 0 || middle[0] > this.width || middle[1] > this.height) return "";
    const [width, height] = size.map((length) => Math.max(length, 9) + 2);
    const box = { x: this.x + middle[0] - width / 2, y: MARGIN.top + middle[1] - height / 2, width, height };
    return svg("g", {}, svg("rect", { class: "halo", ...box }), svg("rect", { class: `mark ${kind}`, stroke: colour, ...box }));
  }
}
