// Boxes and lines: parts of the picture whose pixels are measured. They stay where they are on the picture while the scene moves
// below them, as those of a thermal camera do.

const MOVING_PIXELS = 20000;  // of an area that are measured while something moves
const SURFACE = 0.5;  // alpha of a pixel that shows a surface, not the edge of the scene
const LINE_POINTS = 400;
const CORNERS = ["x1", "y1", "z1", "x2", "y2", "z2"];  // columns of a table of boxes in the scene
const CORNER_POINTS = 12;  // of a box, along each side, that are looked up in the scene
const LEFT_OUT = 0.02;  // share of them at each end of an axis that may lie elsewhere: on what is seen past an edge
const MARGIN = 0.05;  // of its longest edge, by which a box in the scene is wider to each side: a wall is not flat, and depths are rough

class Areas {
  constructor(viewer) {
    this.viewer = viewer;
    this.list = [];
    this.draft = null;  // what is being drawn
    this.tool = "point";
    this.numbered = { box: 0, line: 0 };
  }

  choose(tool) {
    this.tool = tool;
    this.draft = null;
    this.viewer.request();
  }

  // Drawing one, between pixels of the camera's image -----------------------------------------------------------------

  begin(px, py) {
    if (this.tool === "point") return false;
    this.draft = { kind: this.tool, from: this.share(px, py), to: this.share(px, py) };
    $("readout").hidden = true;
    return true;
  }

  extend(px, py) {
    this.draft.to = this.share(px, py);
    this.viewer.request();
  }

  // Keeps what was drawn; the next drag turns the scene again.
  finish(drawn) {
    const { draft, viewer } = this;
    this.draft = null;
    if (drawn) this.add(draft);
    else viewer.say(`Drag to draw a ${draft.kind}.`);
    viewer.request();
  }

  // Around the middle of the picture, for the keyboard.
  addInMiddle() {
    const half = this.tool === "box" ? 0.125 : 0;
    this.add({ kind: this.tool, from: [0.375, 0.5 - half], to: [0.625, 0.5 + half] });
  }

  add(area) {
    if (this.list.length === COLOURS.length) this.list.shift();
    const used = this.list.map((one) => one.colour);
    this.numbered[area.kind] += 1;
    this.list.push({ ...area, name: `${area.kind} ${this.numbered[area.kind]}`, since: performance.now(), colour: COLOURS.findLast((one) => !used.includes(one)) });
    this.choose("point");
  }

  // As a share of the camera's image: cameras may have images of several sizes.
  share(px, py) {
    const { width, height } = this.viewer.camera;
    return [px / width, py / height];
  }

  // Place on the canvas, in its pixels.
  place([right, down]) {
    const { view, camera } = this.viewer;
    return [right * camera.width * view.scale + view.left, down * camera.height * view.scale + view.top];
  }

  // Measuring ---------------------------------------------------------------------------------------------------------

  // The rectangle of whole pixels of the canvas around an area; null outside.
  bounds({ from, to }) {
    const { width, height } = $("canvas"), [a, b] = [this.place(from), this.place(to)];
    const end = (i, size) => [Math.min(a[i], b[i]), Math.max(a[i], b[i])].map((one) => Math.floor(Math.min(Math.max(one, 0), size - 1)));
    const outside = [width, height].some((size, i) => Math.max(a[i], b[i]) < 0 || Math.min(a[i], b[i]) >= size);
    const [[left, right], [top, bottom]] = [end(0, width), end(1, height)];
    return outside ? null : { left, top, width: right - left + 1, height: bottom - top + 1 };
  }

  // Pixels of the canvas that an area measures, with their places along it: a box in steps, a line at even distances.
  pixels(area, bounds, step) {
    const found = [];
    if (area.kind === "box") {
      for (let y = 0; y < bounds.height; y += step) for (let x = 0; x < bounds.width; x += step) found.push([bounds.left + x, bounds.top + y]);
      return found;
    }
    const { width, height } = $("canvas"), a = this.place(area.from), b = this.place(area.to);
    const count = Math.max(Math.ceil(Math.max(Math.abs(b[0] - a[0]), Math.abs(b[1] - a[1]))), 1);
    for (let i = 0; i <= count; i++) {
      const x = Math.floor(a[0] + i / count * (b[0] - a[0])), y = Math.floor(a[1] + i / count * (b[1] - a[1]));
      if (x >= 0 && y >= 0 && x < width && y < height) found.push([x, y, i / count]);
    }
    return found;
  }

  // Values of an area in the picture; of a box that is large, every n-th pixel while something moves.
  measure(area, moving) {
    const { viewer } = this, bounds = this.bounds(area);
    area.found = null;
    if (!bounds) return;
    const { left, top, width, height } = bounds, content = viewer.drawing.read("first", left, top, width, height);
    const ofRun = viewer.blendedOfRun(left, top, width, height);
    const step = moving && area.kind === "box" ? Math.max(1, Math.ceil(Math.sqrt(width * height / MOVING_PIXELS))) : 1;
    const values = this.pixels(area, bounds, step).map(([x, y, along]) => {
      const j = 4 * ((height - 1 - y + top) * width + x - left);
      return { x, y, along, value: content[j + 3] > SURFACE ? viewer.valueOf(content, j, x, y, ofRun) : null };
    });
    area.found = summary(values, step * step);
    const { isotherm } = viewer, log = viewer.attribute?.log;
    if (area.found) area.found.marked = isotherm.ends && isotherm.share(values.flatMap(({ value }) => value === null ? [] : [log ? Math.log10(value) : value]));
    if (area.kind === "line") area.profile = values;
  }

  measureAll(moving) {
    this.list.forEach((area) => this.measure(area, moving));
  }

  // Two opposite corners of a box in the scene around the surfaces that a box on the picture shows, in the coordinates of the scene's
  // files, as src/prepare.py takes them (correct.regions); nulls for a line, and where there is no surface.
  corners(area) {
    const { camera, splats, told } = this.viewer, origin = told.origin || [0, 0, 0], places = [];
    const along = (i, axis) => area.from[axis] + (i + 0.5) / CORNER_POINTS * (area.to[axis] - area.from[axis]);
    for (let i = 0; area.kind === "box" && i < CORNER_POINTS ** 2; i++) {
      const [px, py] = [along(i % CORNER_POINTS, 0) * camera.width, along(Math.floor(i / CORNER_POINTS), 1) * camera.height];
      const { left, depth } = splats.weightsAt(camera, px, py);
      if (1 - left > SURFACE) places.push(plus(camera.point(px, py, depth), origin));
    }
    if (!places.length) return new Array(6).fill(null);
    const ends = [0, 1, 2].map((axis) => {
      const sorted = places.map((place) => place[axis]).sort((a, b) => a - b), out = Math.floor(LEFT_OUT * sorted.length);
      return [sorted[out], sorted[sorted.length - 1 - out]];
    });
    const longest = Math.max(...ends.map(([low, high]) => high - low), 1e-9), digits = Math.max(0, 3 - Math.floor(Math.log10(longest)));
    return [-1, 1].flatMap((side, i) => ends.map((end) => (end[i] + side * MARGIN * longest).toFixed(digits)));
  }

  // A table with a row for each box and line, as the panel shows them: what is measured, when, values, and where a box lies.
  table() {
    const { viewer } = this, { told, state } = viewer, unit = viewer.unit ? ` (${viewer.unit})` : "", digits = viewer.unit ? 3 : 5;
    const quoted = (text) => `"${text.replaceAll('"', '""')}"`, values = viewer.attribute ? (value) => value.toPrecision(6) : (value) => value.toFixed(digits);
    const when = told.span ? [["time (s)", state.time.toFixed(3)], ...clockColumn(told, [state.time]).map(([name, [clock]]) => [name, clock])] : [];
    this.measureAll(false);
    const rows = this.list.map(({ name, found }, k) => [["name", name], ["values", quoted(viewer.shownName)], ...when,
      [`min${unit}`, found && values(found.cold.value)], [`mean${unit}`, found && values(found.mean)], [`max${unit}`, found && values(found.hot.value)],
      [`standard deviation${unit}`, found && values(found.deviation)], ["pixels", found ? found.count : 0],
      ...this.corners(this.list[k]).map((place, i) => [CORNERS[i], place]),
      ...viewer.isotherm.ends ? [[quoted(`${viewer.isotherm.words} (%)`), found && (100 * found.marked).toFixed(2)]] : []]);
    return [rows[0].map(([name]) => name), ...rows.map((row) => row.map(([, cell]) => cell ?? ""))].map((row) => row.join()).join("\n") + "\n";
  }

  // Showing -----------------------------------------------------------------------------------------------------------

  draw() {
    const lines = this.list.filter((area) => area.kind === "line" && area.found);
    $("profile").style.display = lines.length ? "" : "none";
    if (lines.length) {
      const curves = lines.map(({ colour, profile }) => ({ colour, dots: [], ...evenly(profile) }));
      drawCurves($("profile"), [0, 1], curves, null, this.viewer.unit, null, [0.01, "along the line (%)"]);
    }
    $("areasNote").hidden = $("areasTable").hidden = !this.list.length;
    for (const input of document.querySelectorAll("input[name=tool]")) input.checked = input.value === this.tool;
    refill($("areas"), this.list.map((area) => this.item(area)));
  }

  // A box or a line in the list: its mean, its ends, how far values spread.
  item(area) {
    const { viewer } = this, { found } = area;
    const item = entry(area.colour, area.name, found ? viewer.words(found.mean) : "nothing there", () => {
      this.list = this.list.filter((one) => one !== area);
      viewer.request();
    });
    item.className = area.kind;
    if (found) {
      item.append(Object.assign(document.createElement("small"), { textContent: `min ${viewer.words(found.cold.value)} · max ${viewer.words(found.hot.value)} · `
        + `σ ${viewer.amount(found.deviation)} · ${found.count.toLocaleString("en")} pixels${found.marked === null ? "" : ` · ${percent(found.marked)} ${viewer.isotherm.words}`}` }));
    }
    return item;
  }

  // Outlines and the hottest and the coldest pixel, in an SVG of the picture's size.
  mark(svg, ratio) {
    for (const area of [...this.list, ...(this.draft ? [{ ...this.draft, colour: "#fff" }] : [])]) {
      const [a, b] = [this.place(area.from), this.place(area.to)].map((place) => place.map((one) => one / ratio));
      const d = area.kind === "box" ? `M${a[0]},${a[1]}H${b[0]}V${b[1]}H${a[0]}Z` : `M${a.join()}L${b.join()}`;
      node("path", { class: "area", d, fill: "none", stroke: "#000", "stroke-opacity": 0.6, "stroke-width": 4 }, svg);
      node("path", { class: "area", d, fill: "none", stroke: area.colour, "stroke-width": 2 }, svg);
      if (!area.name) continue;
      const corner = area.kind === "box" ? [Math.min(a[0], b[0]), Math.min(a[1], b[1])] : a;
      node("text", { x: corner[0] + 3, y: corner[1] > 20 ? corner[1] - 6 : corner[1] + 16 }, svg, area.name);
      if (!area.found) continue;
      for (const [{ x, y }, up] of [[area.found.hot, -1], [area.found.cold, 1]]) {
        const [cx, cy] = [(x + 0.5) / ratio, (y + 0.5) / ratio];  // a triangle that points at it: from above the hottest, from below the coldest
        node("path", { class: "area", d: `M${cx},${cy}l-5,${9 * up}h10Z`, fill: up < 0 ? "#ff5a3c" : "#58a6ff", stroke: "#fff", "stroke-width": 1.2 }, svg);
      }
    }
  }
}

// Of values [{x, y, value}] that each stand for so many pixels: the hottest, the coldest, mean, standard deviation and how many there
// are; null where there is none.
function summary(values, each = 1) {
  const known = values.filter(({ value }) => value !== null);
  if (!known.length) return null;
  let hot = known[0], cold = known[0], total = 0, squares = 0;
  const about = known[0].value;
  for (const one of known) {
    if (one.value > hot.value) hot = one;
    if (one.value < cold.value) cold = one;
    total += one.value - about;
    squares += (one.value - about) ** 2;
  }
  const mean = total / known.length;
  return { hot, cold, mean: about + mean, deviation: Math.sqrt(Math.max(squares / known.length - mean * mean, 0)), count: each * known.length };
}

// A profile for a chart: at most LINE_POINTS of its pixels, null where there is no surface.
function evenly(profile) {
  const step = Math.max(1, Math.ceil(profile.length / LINE_POINTS)), kept = profile.filter((_, i) => i % step === 0);
  return { at: kept.map(({ along }) => along), model: kept.map(({ value }) => value) };
}
