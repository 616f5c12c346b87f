// Probes: points of the scene that are measured over time.

const COLOURS = ["#ff9e4a", "#6cb6ff", "#7bd88f", "#f07ab8", "#c9a2ff", "#e8d44d", "#5fd3d0", "#ff7b72"];
const CHART_TIMES = 121;

class Probes {
  constructor(viewer) {
    this.viewer = viewer;
    this.list = [];
    this.numbered = 0;
    this.reference = null;  // the probe from which differences of others are counted
    const { span } = viewer.told, [start, end] = span || [0, 0];
    this.times = Array.from({ length: span ? CHART_TIMES : 1 }, (_, i) => start + i / (CHART_TIMES - 1) * (end - start));
  }

  // A probe at a pixel of the camera's image; null where there is nothing.
  pin(px, py) {
    const { viewer } = this, { camera, splats } = viewer;
    const pixel = splats.weightsAt(camera, px, py);
    if (pixel.left > 0.9) {
      viewer.say("Nothing is there to measure.");
      return null;
    }
    if (this.list.length === COLOURS.length) this.list.shift();
    const used = this.list.map((probe) => probe.colour);
    this.numbered += 1;
    const probe = { name: String(this.numbered), colour: COLOURS.find((one) => !used.includes(one)), pixel, camera, px, py, since: performance.now(),
      point: camera.point(px, py, pixel.depth), dots: [] };
    this.list.push(probe);
    this.measure(probe);
    if (viewer.told.span && !splats.layer("truth")) this.gatherDots(probe, 0);
    viewer.request();
    return probe;
  }

  // A probe at a point of the scene, where the camera sees it.
  pinPoint(point) {
    const { camera, splats } = this.viewer, seen = camera.project(point);
    if (!seen || seen[0] < 0 || seen[1] < 0 || seen[0] > camera.width || seen[1] > camera.height) return;
    const pixel = splats.weightsAt(camera, seen[0], seen[1]);
    if (pixel.left < 0.5 && Math.abs(pixel.depth - seen[2]) < 0.05 * seen[2]) this.pin(seen[0], seen[1]);
  }

  // Curves of the quantity that is shown.
  measure(probe) {
    const { splats } = this.viewer, truth = splats.layer("truth");
    probe.layer = this.viewer.layer || splats.layers[0];
    probe.model = splats.seriesAt(probe.pixel, probe.layer, this.times);
    probe.truth = truth && probe.layer !== truth ? splats.seriesAt(probe.pixel, truth, this.times) : null;
  }

  // What training images recorded of a probe: from cameras that see the point and nothing before it.
  gatherDots(probe, i) {
    const { cameras, splats } = this.viewer;
    if (i >= cameras.length || !this.list.includes(probe)) return this.viewer.request();
    const one = cameras[i], seen = one.camera.project(probe.point);
    if (seen && one.time !== null && seen[0] >= 0 && seen[1] >= 0 && seen[0] < one.width && seen[1] < one.height) {
      const { depth } = splats.weightsAt(one.camera, seen[0], seen[1]);
      const [rows, columns] = one.size;
      const value = one.recorded[Math.floor(seen[1] / one.height * rows) * columns + Math.floor(seen[0] / one.width * columns)];
      if (Math.abs(depth - seen[2]) < 0.05 * seen[2] && !Number.isNaN(value)) probe.dots.push([one.time, value]);
    }
    setTimeout(() => this.gatherDots(probe, i + 1));
    return undefined;
  }

  draw() {
    const { told, state } = this.viewer, charted = told.span && this.list.length;
    if (!this.list.includes(this.reference) || this.list.length < 2) this.reference = null;
    $("curves").hidden = !this.list.length;
    $("chart").style.display = charted ? "" : "none";
    if (told.span) drawCurves($("chart"), this.times, this.list, state.time, told.unit, told.record);
    const dots = this.list.some((probe) => probe.dots.length), truth = this.list.some((probe) => probe.truth);
    $("chartNote").textContent = charted ? `Lines: model${truth ? "; dashes: truth" : dots ? "; dots: training images" : ""}.` : "";
    refill($("probes"), this.list.map((probe) => this.item(probe)));
  }

  valueNow(probe) {
    return this.viewer.splats.seriesAt(probe.pixel, probe.layer, [this.viewer.state.time])[0];
  }

  // A probe in the list: its value now, how far that is from the reference, and what the model learned there.
  item(probe) {
    const { splats, told } = this.viewer, { reference } = this, value = this.valueNow(probe);
    const item = entry(probe.colour, `probe ${probe.name}`, told.unit ? `${value.toFixed(2)} ${told.unit}` : value.toFixed(4), () => {
      this.list = this.list.filter((one) => one !== probe);
      this.viewer.request();
    });
    if (this.list.length > 1) {
      const apart = reference && reference !== probe ? value - this.valueNow(reference) : null;
      const button = Object.assign(document.createElement("button"), { textContent: apart === null ? "Δ" : `Δ ${signed(apart, told.unit ? 2 : 4)}`,
        title: apart === null ? `Differences from probe ${probe.name}` : `Probe ${probe.name} minus probe ${reference.name}` });
      button.setAttribute("aria-pressed", String(reference === probe));
      button.setAttribute("aria-label", apart === null ? button.title : `${button.title}: ${button.textContent}`);
      button.onclick = () => {
        this.reference = reference === probe ? null : probe;
        this.viewer.request();
      };
      item.lastChild.before(button);
    }
    if (splats.attributes.length) {
      const number = (value) => Number.isNaN(value) ? "unknown" : Number(value.toPrecision(3));
      const learned = splats.attributes.map((one) => `${one.label} ${number(splats.attributeAt(probe.pixel, one))} ${one.unit}`.trim());
      item.append(Object.assign(document.createElement("small"), { textContent: learned.join(" · ") }));
    }
    return item;
  }

  // A table with a row for each moment: the clock where it is known; of each probe the model, the truth where it is known, and its place
  // in the coordinates of the scene's files.
  table() {
    const { told } = this.viewer, unit = told.unit ? ` (${told.unit})` : "", origin = told.origin || [0, 0, 0];
    const values = (all) => all.map((value) => value.toFixed(unit ? 3 : 5)), still = (value) => this.times.map(() => value);
    const columns = told.span ? [["time (s)", this.times.map((time) => time.toFixed(3))], ...clockColumn(told, this.times)] : [];
    for (const one of this.list) {
      columns.push([`probe ${one.name}${unit}`, values(one.model)]);
      if (one.truth) columns.push([`probe ${one.name} truth${unit}`, values(one.truth)]);
    }
    for (const one of this.list) ["x", "y", "z"].forEach((axis, i) => columns.push([`probe ${one.name} ${axis}`, still(Number((one.point[i] + origin[i]).toPrecision(12)))]));
    return [columns.map(([name]) => name), ...this.times.map((_, i) => columns.map(([, cells]) => cells[i]))].map((row) => row.join()).join("\n") + "\n";
  }
}

// The column of a table that says what the clock said, where it is known.
function clockColumn({ start, utc }, times) {
  if (typeof start !== "number") return [];
  return [[`clock (${utc ? "UTC" : "camera"})`, times.map((time) => new Date(1000 * (start + time)).toISOString().slice(0, utc ? 24 : 23))]];
}

const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

// An entry of a list of what is measured: swatch, name, value, and a button that takes it away.
function entry(colour, name, value, remove) {
  const item = document.createElement("li"), swatch = document.createElement("i");
  const text = (content) => Object.assign(document.createElement("span"), { textContent: content });
  swatch.style.background = colour;
  const close = Object.assign(document.createElement("button"), { textContent: "✕", title: `Take ${name} away` });
  close.setAttribute("aria-label", close.title);
  close.onclick = remove;
  item.append(swatch, text(name), text(value), close);
  return item;
}

// Other entries in a list; the focus stays on the button where it was.
function refill(list, items) {
  const focused = [...list.querySelectorAll("button")].indexOf(document.activeElement);
  list.replaceChildren(...items);
  if (focused >= 0) (list.querySelectorAll("button")[focused] || $("canvas")).focus();
}
