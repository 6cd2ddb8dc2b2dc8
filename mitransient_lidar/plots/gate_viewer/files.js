// What a user takes away from the page: records as CSV, the picture as PNG, and a link that keeps gate and pixels.

const PNG_SCALE = 2; // dots per CSS pixel
const DRAWN = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-opacity", "stroke-dasharray", "paint-order", "opacity", "color", "font"];

/** Offer a file to save. */
function save(content, type, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Return the records of the plotted pixels as lines of CSV: time, depth if known, and value and standard error of each. */
function recordsAsCsv(stack, records) {
  const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
  const known = stack.depth_of_time !== null;
  const heads = records.flatMap(({ pixel, unit, name }) => {
    const head = `${describePixel(stack, pixel)}: ${name} (${unit || "1"})`;
    return [quoted(head), quoted(`${head}, standard error`)];
  });
  const lines = [["time_ns", ...(known ? ["depth_m"] : []), ...heads].join(",")];
  const text = (value) => (Number.isFinite(value) ? +value.toPrecision(7) : "");
  records[0].x.forEach((time, i) => {
    const place = [text(time), ...(known ? [text(depthAt(stack, time))] : [])];
    lines.push([...place, ...records.flatMap(({ y, error }) => [text(y[i]), error ? text(error[i]) : ""])].join(","));
  });
  return `${lines.join("\n")}\n`;
}

/** Return the image of a drawing of the page, whose style sheet it lacks. */
async function imageOf(drawing) {
  const copy = drawing.cloneNode(true);
  const box = drawing.getBoundingClientRect();
  copy.setAttribute("width", box.width);
  copy.setAttribute("height", box.height);
  const [own, copied] = [drawing, copy].map((root) => [root, ...root.querySelectorAll("*")]);
  own.forEach((element, i) => {
    const style = getComputedStyle(element);
    copied[i].setAttribute("style", DRAWN.map((name) => `${name}:${style.getPropertyValue(name)}`).join(";"));
  });
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
  await image.decode();
  return image;
}

/** Return image, records and their title as a PNG. */
async function pictureAsPng(title) {
  const plots = [byId("image"), byId("curves")].map((plot) => ({ plot, box: plot.getBoundingClientRect() }));
  const head = 34;
  const canvas = document.createElement("canvas");
  canvas.width = PNG_SCALE * (plots[0].box.width + plots[1].box.width);
  canvas.height = PNG_SCALE * (head + Math.max(...plots.map(({ box }) => box.height)));
  const context = canvas.getContext("2d");
  const style = getComputedStyle(document.querySelector("section"));
  context.fillStyle = style.backgroundColor;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.scale(PNG_SCALE, PNG_SCALE);
  context.imageSmoothingEnabled = false;
  context.fillStyle = style.color;
  context.font = `600 15px ${style.fontFamily}`;
  context.fillText(title, 8, 22);
  let left = 0;
  for (const { plot, box } of plots) {
    for (const part of plot.querySelectorAll("canvas, svg")) {
      const place = part.getBoundingClientRect();
      const image = part instanceof HTMLCanvasElement ? part : await imageOf(part);
      context.drawImage(image, left + place.left - box.left, head + place.top - box.top, place.width, place.height);
    }
    left += box.width;
  }
  return new Promise((done) => canvas.toBlob(done, "image/png"));
}

/** Return the part of the address that keeps gate and pixels, such as #gate=20&pixel=40,26&pinned=1,2;3,4. */
function linkOf({ gate, selected, pins, stack: { columns } }) {
  const place = (pixel) => `${Math.floor(pixel / columns)},${pixel % columns}`;
  const pinned = pins.length ? `&pinned=${pins.map((pin) => place(pin.pixel)).join(";")}` : "";
  return `#gate=${gate}&pixel=${place(selected)}${pinned}`;
}

/** Set gate and pixels of the page to those of its address, as far as it has them. */
function followLink(page) {
  const { rows, columns, gates } = page.stack;
  const given = new URLSearchParams(location.hash.slice(1));
  const pixels = (name) => (given.get(name) || "").split(";").flatMap((text) => {
    const [row, column] = text.split(",").map((part) => (/^\d+$/.test(part) ? Number(part) : NaN));
    return row < rows && column < columns ? [row * columns + column] : [];
  });
  const gate = /^\d+$/.test(given.get("gate")) ? Number(given.get("gate")) : NaN;
  if (gate < gates) page.gate = gate;
  page.selected = pixels("pixel")[0] ?? page.selected;
  if (given.has("pinned")) page.pins = [];
  for (const pixel of pixels("pinned")) page.pin(pixel);
  page.update();
}
