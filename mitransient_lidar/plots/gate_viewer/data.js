// Data of the page: embedded arrays, quantities derived from them, and formats of numbers.

const COLOUR_DECADES = 4; // at most, of a logarithmic range of colours
const SIGNIFICANT = 5; // smallest rise of an echo, in standard errors

/** Return an embedded array, with the bytes of each float32 rejoined; null if absent. */
async function loadArray(name) {
  if (byId(name) === null) return null;
  const planes = new Uint8Array(await unpacked(name).arrayBuffer());
  const count = planes.length / 4;
  const words = new Uint32Array(count);
  const [second, third, fourth] = [count, 2 * count, 3 * count];
  for (let i = 0; i < count; i++) {
    words[i] = planes[i] | (planes[second + i] << 8) | (planes[third + i] << 16) | (planes[fourth + i] << 24);
  }
  return new Float32Array(words.buffer);
}

/** Load the metadata and gates as (gate, row, column); waveforms only if the gates are their time bins. */
async function loadStack() {
  const stack = JSON.parse(byId("metadata").textContent);
  stack.gates = stack.gate_start.length;
  stack.pixels = stack.rows * stack.columns;
  for (const name of ["gate_energy", "gate_energy_stderr", "surface_time", "depth_per_ns"]) stack[name] = await loadArray(name);
  if (stack.gate_energy === null) {
    await loadWaveforms(stack);
    stack.gate_energy = timeFirst(stack, stack.waveform.power);
    stack.gate_energy_stderr = timeFirst(stack, stack.waveform.error);
  }
  stack.depth_name = stack.surface_time ? "depth on the axis" : "depth";
  stack.gate_middle = stack.gate_start.map((start, k) => start + stack.gate_width[k] / 2);
  stack.maps = Object.fromEntries(
    Object.entries(stack.colour_maps).map(([name, text]) => [name, decodeBase64(text)[0]])
  );
  return stack;
}

/** Load the waveforms as (row, column, time), if there are any that are not loaded. */
async function loadWaveforms({ waveform }) {
  if (!waveform || waveform.power) return;
  const power = await loadArray("waveform");
  waveform.error = await loadArray("waveform_stderr");
  waveform.power = power;
}

/** Return values of pixels over time as images, one after the other. */
function timeFirst({ pixels, gates }, values) {
  const images = new Float32Array(values.length);
  for (let pixel = 0; pixel < pixels; pixel++) {
    for (let k = 0; k < gates; k++) images[k * pixels + pixel] = values[pixel * gates + k];
  }
  return images;
}

/** Return the values of a view of the image, their unit, and their errors if known. */
function picture(stack, view, gate) {
  const { pixels, gates, gate_energy: energy, gate_energy_stderr: error } = stack;
  if (view === "gate") {
    const slice = [gate * pixels, (gate + 1) * pixels];
    return { values: energy.subarray(...slice), errors: error.subarray(...slice), ...stack.quantity };
  }
  // Along its line of sight, each pixel has its own depth at a time.
  const { surface_time: zero, depth_per_ns: scale } = stack;
  const place = zero ? stack.gate_middle : stack.gate_depth || stack.gate_middle;
  const depth = (pixel, value) => (zero ? (value - zero[pixel]) * scale[pixel] : value);
  const values = new Float32Array(pixels);
  for (let pixel = 0; pixel < pixels; pixel++) {
    if (view === "echo") {
      const echo = strongestEcho(stack, pixel, gate);
      values[pixel] = echo === null ? NaN : depth(pixel, place[echo]);
      continue;
    }
    let [sum, moment] = [0, 0];
    for (let k = gate; k < gates; k++) {
      sum += energy[k * pixels + pixel];
      moment += energy[k * pixels + pixel] * place[k];
    }
    if (view === "sum") values[pixel] = stack.sum * sum;
    else values[pixel] = sum > 0 ? depth(pixel, moment / sum) : NaN;
  }
  if (view === "sum") return { values, errors: null, unit: "J", name: "energy" };
  const known = zero || stack.gate_depth;
  return { values, errors: null, unit: known ? "m" : "ns", name: known ? "depth" : "time" };
}

/**
 * Return the gate, from a first one on, with the largest rise above the weakest gate before it; null without a
 * significant rise. The brightest gate would often be the first one, since the backscatter fades with depth.
 */
function strongestEcho({ pixels, gates, gate_energy: energy, gate_energy_stderr: error }, pixel, first) {
  let [valley, best, most] = [first * pixels + pixel, null, 0];
  for (let k = first + 1; k < gates; k++) {
    const at = k * pixels + pixel;
    const rise = energy[at] - energy[valley];
    if (rise > most && rise > SIGNIFICANT * Math.hypot(error[at], error[valley])) [best, most] = [k, rise];
    if (energy[at] < energy[valley]) valley = at;
  }
  return best;
}

/** Return a quantile of the finite values, estimated from a sample if there are many. */
function quantile(values, share) {
  const stride = Math.ceil(values.length / 200000);
  const sample = values.filter((value, i) => i % stride === 0 && Number.isFinite(value)).sort();
  return sample.length ? sample[Math.min(sample.length - 1, Math.floor(share * sample.length))] : NaN;
}

/** Return the smallest and largest finite value. */
function extremes(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low <= high ? [low, high] : [0, 1];
}

/** Return the range of the colours; with `fixed` a linear range of energies starts at zero. */
function colourRange(values, { log, clip, fixed }) {
  let [low, high] = extremes(values);
  if (clip > 0) high = quantile(values, 1 - clip);
  if (log) {
    const positive = values.filter((value) => value > 0);
    low = Math.max(quantile(positive, 0.01) || 0, 10 ** -COLOUR_DECADES * high);
    if (!(high > 0)) return [0.1, 1];
    return low < high ? [low, high] : [high / 10, high];
  }
  if (fixed) low = Math.min(0, low);
  return low < high ? [low, high] : [low, low + (Math.abs(low) || 1)];
}

/** Return a pixel's record as { x, y, error, half, unit }: its waveform or its gates. */
function record(stack, source, pixel) {
  if (source === "gates") {
    const of = (array) => Float32Array.from({ length: stack.gates }, (_, k) => array[k * stack.pixels + pixel]);
    const [y, error] = [of(stack.gate_energy), of(stack.gate_energy_stderr)];
    return { x: stack.gate_middle, half: stack.gate_width.map((width) => width / 2), y, error, ...stack.quantity };
  }
  const { power, error, block, columns, bins, unit, name } = stack.waveform;
  stack.waveform.x ||= Array.from({ length: bins }, (_, i) => stack.waveform.time + i * stack.waveform.step);
  const row = Math.floor(Math.floor(pixel / stack.columns) / block);
  const start = (row * columns + Math.floor((pixel % stack.columns) / block)) * bins;
  const of = (array) => array && array.subarray(start, start + bins);
  return { x: stack.waveform.x, half: null, y: of(power), error: of(error), unit, name };
}

/** Return the depth at a time, null if unknown. */
function depthAt(stack, time) {
  if (!stack.depth_of_time) return null;
  const [offset, slope] = stack.depth_of_time;
  return offset + slope * time;
}

/** Return the name of a pixel, or its row, column and angles, as text. */
function describePixel(stack, pixel) {
  const [row, column] = [Math.floor(pixel / stack.columns), pixel % stack.columns];
  if (stack.names) return stack.names[column];
  const { left, top, across, along } = stack.axes;
  const [angle_x, angle_y] = [top - (row + 0.5) * along, left + (column + 0.5) * across];
  const place = stack.block > 1 ? `block (${row}, ${column})` : `row ${row}, column ${column}`;
  return `${place} · angle_x ${plain(angle_x, 2)}, angle_y ${plain(angle_y, 2)} mrad`;
}

/** Return the power of 1000 that scales a number to between 1 and 1000, and its SI prefix. */
function prefix(number) {
  const signs = ["y", "z", "a", "f", "p", "n", "µ", "m", "", "k", "M", "G"];
  const power = number ? Math.floor(Math.log10(Math.abs(number)) / 3 + 1e-9) : 0;
  const bounded = Math.max(-8, Math.min(3, power));
  return { factor: 10 ** (3 * bounded), sign: signs[bounded + 8] };
}

/** Return a value with its standard error and unit, to the digits that the error supports. */
function withUnit(value, unit, error = null) {
  if (!Number.isFinite(value)) return "no value";
  const known = error !== null && Number.isFinite(error);
  if (unit === "m" || unit === "ns") return `${plain(value, 2)} ${unit}`;
  const { factor, sign } = unit ? prefix(Math.max(Math.abs(value), known ? error : 0)) : { factor: 1, sign: "" };
  const scaled = value / factor;
  if (!known || error === 0) return `${scaled.toPrecision(3)} ${sign}${unit}`;
  const digits = Math.max(0, Math.min(5, 1 - Math.floor(Math.log10(error / factor))));
  return `${plain(scaled, digits)} ± ${plain(error / factor, digits)} ${sign}${unit}`;
}

/** Return a number with a fixed number of decimals and a typographic minus sign. */
function plain(number, digits) {
  const text = number.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
