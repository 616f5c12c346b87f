// Probes: points of the scene that are measured over time.

const COLOURS = ["#ff9e4a", "#6cb6ff", "#7bd88f", "#f07ab8", "#c9a2ff", "#e8d44d", "#5fd3d0", "#ff7b72"];
const CHART_TIMES = 121;

class Probes {
  constructor(viewer) {
    this.viewer = viewer;
    this.list = [];
    this.numbered = 0;
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
    const probe = { name: String(this.numbered), colour: COLOURS.find((one) => !used.includes(one)), pixel, camera, px, py,
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
    const { told, state } = this.viewer, list = $("probes"), charted = told.span && this.list.length;
    $("curves").hidden = !charted;
    $("chart").style.display = charted ? "" : "none";
    if (told.span) drawCurves($("chart"), this.times, this.list, state.time, told.unit, told.record);
    const dots = this.list.some((probe) => probe.dots.length), truth = this.list.some((probe) => probe.truth);
    $("chartNote").textContent = charted ? `Lines: model${truth ? "; dashes: truth" : dots ? "; dots: training images" : ""}.` : "";
    const items = this.list.map((probe) => this.item(probe));
    const focused = [...list.querySelectorAll("button")].indexOf(document.activeElement);
    list.replaceChildren(...items);
    if (focused >= 0) (list.querySelectorAll("button")[focused] || $("canvas")).focus();
  }

  // A probe in the list: its value now, and what the model learned there.
  item(probe) {
    const { splats, state, told } = this.viewer;
    const item = document.createElement("li"), swatch = document.createElement("i");
    const [value] = splats.seriesAt(probe.pixel, probe.layer, [state.time]);
    const text = (content) => Object.assign(document.createElement("span"), { textContent: content });
    swatch.style.background = probe.colour;
    const close = Object.assign(document.createElement("button"), { textContent: "✕", title: `Take probe ${probe.name} away` });
    close.setAttribute("aria-label", close.title);
    close.onclick = () => {
      this.list = this.list.filter((one) => one !== probe);
      this.viewer.request();
    };
    item.append(swatch, text(`probe ${probe.name}`), text(told.unit ? `${value.toFixed(2)} ${told.unit}` : value.toFixed(4)), close);
    if (splats.attributes.length) {
      const number = (value) => Number.isNaN(value) ? "unknown" : Number(value.toPrecision(3));
      const learned = splats.attributes.map((one) => `${one.label} ${number(splats.attributeAt(probe.pixel, one))} ${one.unit}`.trim());
      item.append(Object.assign(document.createElement("small"), { textContent: learned.join(" · ") }));
    }
    return item;
  }

  // The curves as a table: a row for each moment, and of each probe the model and, where it is known, the truth.
  table() {
    const unit = this.viewer.told.unit ? ` (${this.viewer.told.unit})` : "";
    const columns = this.list.flatMap((one) => [[`probe ${one.name}${unit}`, one.model], [`probe ${one.name} truth${unit}`, one.truth]])
      .filter(([, values]) => values);
    const rows = this.times.map((time, i) => [time.toFixed(3), ...columns.map(([, values]) => values[i].toFixed(unit ? 3 : 5))]);
    return [["time (s)", ...columns.map(([name]) => name)], ...rows].map((row) => row.join()).join("\n") + "\n";
  }
}
