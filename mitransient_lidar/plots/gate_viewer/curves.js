// The plot of the records of pixels.

const ROOM = { left: 62, right: 14, top: 40, bottom: 42 };
const DECADES = 6; // at most, on a logarithmic axis

/** Plot of the records: limits and drawing. */
class CurveView {
  constructor(stack) {
    this.stack = stack;
    this.plot = document.getElementById("curve-plot");
  }

  /** Return the time at the position of a pointer event. */
  timeAt(event) {
    const box = this.plot.getBoundingClientRect();
    const share = (event.clientX - box.left - ROOM.left) / this.width;
    return this.first + Math.max(0, Math.min(1, share)) * (this.last - this.first);
  }

  /** Draw curves, each { pixel, colour, kind, x, y, error, half, unit }. */
  draw(curves, { gate, log, whole, moment }) {
    const box = this.plot.getBoundingClientRect();
    this.width = Math.max(1, box.width - ROOM.left - ROOM.right);
    this.height = Math.max(1, box.height - ROOM.top - ROOM.bottom);
    this.log = log;
    this.setTimes(curves[0], whole);
    // Previewed curves do not change the axis.
    this.setValues(curves.filter((curve) => curve.kind !== "preview"));
    const inside = svg("clipPath", { id: "inside" }, svg("rect", this.frame()));
    const lines = svg("g", { "clip-path": "url(#inside)" });
    lines.append(this.gateBand(gate), ...curves.map((curve) => this.curve(curve)));
    if (moment !== null) lines.append(svg("path", { class: "moment", d: `M${this.x(moment)} ${ROOM.top}v${this.height}` }));
    this.plot.replaceChildren(inside, ...this.valueAxis(curves[0]), ...this.timeAxes(), lines);
  }

  frame() {
    return { x: ROOM.left, y: ROOM.top, width: this.width, height: this.height };
  }

  x(time) {
    return ROOM.left + (this.width * (time - this.first)) / (this.last - this.first);
  }

  y(value) {
    const share = this.log
      ? Math.log(Math.max(value, 1e-3 * this.low) / this.low) / Math.log(this.high / this.low)
      : (value - this.low) / (this.high - this.low);
    return ROOM.top + this.height * (1 - share);
  }

  /** Set the time axis to the window of the echoes, to the gates with a margin, or to the full record. */
  setTimes({ x, half }, whole) {
    const { gate_start: start, gate_width: width, window } = this.stack;
    const ends = start.map((time, k) => time + width[k]);
    const [first, last] = window || [Math.min(...start), Math.max(...ends)];
    const margin = window ? 0 : half === null ? 0.06 * (last - first) : 0.02 * (last - first);
    [this.first, this.last] = [first - margin, last + margin];
    if (half !== null || !(whole || this.last < x[0] || this.first > x[x.length - 1])) return;
    const step = this.stack.waveform.step / 2;
    [this.first, this.last] = [x[0] - step, x[x.length - 1] + step];
  }

  /** Set the value axis to the visible values; a logarithmic one ends where they fall below three standard errors. */
  setValues(curves) {
    const significant = [];
    let [low, high] = [0, 0];
    for (const { x, y, error } of curves) {
      y.forEach((value, i) => {
        if (!Number.isFinite(value) || x[i] < this.first || x[i] > this.last) return;
        low = Math.min(low, value);
        high = Math.max(high, value + ((error && error[i]) || 0));
        if (value > 0 && !(error && value < 3 * error[i])) significant.push(value);
      });
    }
    if (!(high > low)) high = low + 1;
    [this.low, this.high] = [low, high + 0.04 * (high - low)];
    if (!this.log) return;
    const floor = significant.length ? 0.5 * quantile(Float32Array.from(significant), 0.01) : 0;
    this.high = high > 0 ? 1.8 * high : 1;
    this.low = Math.max(floor, this.high * 10 ** -DECADES);
  }

  gateBand(gate) {
    const { gate_start: start, gate_width: width } = this.stack;
    const [left, right] = [this.x(start[gate]), this.x(start[gate] + width[gate])];
    return svg("rect", { class: "gate", x: left, y: ROOM.top, width: Math.max(1, right - left), height: this.height });
  }

  curve({ x, y, error, half, kind, colour, dashes }) {
    const group = svg("g", { class: kind, ...(colour ? { style: `color: ${colour}; --dashes: ${dashes}` } : {}) });
    const [first, last] = this.seen(x);
    let [line, upper, lower, bars] = ["", "", "", ""];
    for (let i = first; i < last; i++) {
      if (!Number.isFinite(y[i])) continue;
      const [left, height] = [this.x(x[i]).toFixed(1), this.y(y[i]).toFixed(1)];
      line += `${line ? "L" : "M"}${left} ${height}`;
      if (!error) continue;
      const [above, below] = [this.y(y[i] + error[i]).toFixed(1), this.y(y[i] - error[i]).toFixed(1)];
      if (half === null) {
        upper += `${upper ? "L" : "M"}${left} ${above}`;
        lower = `L${left} ${below}${lower}`;
      } else {
        bars += `M${left} ${above}V${below}`;
        group.append(svg("circle", { cx: left, cy: height, r: 2.4, fill: "currentColor" }));
      }
    }
    if (upper) group.append(svg("path", { class: "band", d: `${upper}${lower}Z` }));
    group.append(svg("path", { class: "line", d: line }));
    if (bars) group.append(svg("path", { class: "line bars", d: bars }));
    return group;
  }

  /** Return the range of indices of the visible times, with one more on either side. */
  seen(x) {
    const [first, after] = [x.findIndex((time) => time >= this.first), x.findIndex((time) => time > this.last)];
    return [Math.max(0, first - 1), after < 0 ? x.length : after + 1];
  }

  valueAxis({ name: quantity, unit }) {
    const { ticks, texts, sign } = tickLabels(this.low, this.high, this.log, this.height / 50, unit);
    const elements = ticks.flatMap((tick, i) => [
      svg("path", { class: "grid", d: `M${ROOM.left} ${this.y(tick)}h${this.width}` }),
      svg("text", { class: "value-tick", x: ROOM.left - 8, y: this.y(tick) + 4, "text-anchor": "end" }, texts[i]),
    ]);
    const turn = `translate(16 ${ROOM.top + this.height / 2}) rotate(-90)`;
    const name = unit ? `${quantity} (${sign}${unit})` : `${quantity} per bin`;
    elements.push(svg("text", { class: "name", transform: turn, "text-anchor": "middle" }, name));
    return elements;
  }

  timeAxes() {
    const [bottom, middle] = [ROOM.top + this.height, ROOM.left + this.width / 2];
    const name = (y, text) => svg("text", { class: "name", x: middle, y, "text-anchor": "middle" }, text);
    const elements = [svg("rect", { class: "axis", ...this.frame() })];
    const { ticks, digits } = linearTicks(this.first, this.last, this.width / 70);
    for (const tick of ticks) {
      elements.push(
        svg("path", { class: "axis", d: `M${this.x(tick)} ${bottom}v5` }),
        svg("text", { x: this.x(tick), y: bottom + 18, "text-anchor": "middle" }, plain(tick, digits))
      );
    }
    elements.push(name(bottom + 36, this.stack.time_label));
    if (!this.stack.depth_of_time) return elements;
    const [offset, slope] = this.stack.depth_of_time;
    const depths = linearTicks(offset + slope * this.first, offset + slope * this.last, this.width / 60);
    for (const tick of depths.ticks) {
      const x = this.x((tick - offset) / slope);
      elements.push(
        svg("path", { class: "axis", d: `M${x} ${ROOM.top}v-5` }),
        svg("text", { x, y: ROOM.top - 9, "text-anchor": "middle" }, plain(tick, depths.digits))
      );
    }
    elements.push(name(ROOM.top - 26, `${this.stack.depth_name} (m)`));
    return elements;
  }
}
