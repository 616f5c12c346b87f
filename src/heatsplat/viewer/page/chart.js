// Small drawings in SVG: curves of probes over time, and the histogram under the colours.

const SVG = "http://www.w3.org/2000/svg";

function node(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

// Round numbers between two ends.
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((size) => size >= raw) || raw;
  const found = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + step * 1e-6; tick += step) found.push(Number(tick.toPrecision(10)));
  return found;
}

// Seconds as people say them over a span: [number, unit].
function timeScale(span) {
  if (span < 300) return [1, "s"];
  return span < 3 * 3600 ? [60, "min"] : [3600, "h"];
}

function timeAxis(times) {
  const [divisor, word] = timeScale(times.at(-1) - times[0]);
  return [divisor, `time (${word})`];
}

// Curves: [{colour, name, model, truth, dots}] over times, or over places of their own (at), with gaps where the model is null; a
// line at the present. axis: what one unit of the labels below is, and their words; of time by default.
function drawCurves(svg, times, curves, now, unit, record, axis = timeAxis(times)) {
  svg.replaceChildren();
  const width = Math.max(svg.clientWidth, 200), height = Math.max(svg.clientHeight, 120);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const left = 40, right = width - 8, top = 10, bottom = height - 30;
  const all = curves.flatMap((one) => [...one.model.filter((value) => value !== null), ...(one.truth || []), ...one.dots.map((dot) => dot[1])]);
  if (!all.length || times.length < 2) return;
  let low = Math.min(...all), high = Math.max(...all);
  const pad = Math.max(0.06 * (high - low), unit ? 0.1 : 0.002);
  low -= pad;
  high += pad;
  const first = times[0], last = times.at(-1);
  const x = (time) => left + (time - first) / (last - first) * (right - left);
  const y = (value) => bottom - (value - low) / (high - low) * (bottom - top);
  if (record) {
    for (const [from, to] of [[first, record[0]], [record[1], last]]) {
      if (to > from) node("rect", { class: "beyond", x: x(from), y: top, width: x(to) - x(from), height: bottom - top }, svg);
    }
  }
  const [divisor, words] = axis;
  for (const tick of ticks(low, high, 4)) {
    node("line", { class: "grid", x1: left, x2: right, y1: y(tick), y2: y(tick) }, svg);
    node("text", { x: left - 5, y: y(tick) + 4, "text-anchor": "end" }, svg, String(tick));
  }
  for (const tick of ticks(first / divisor, last / divisor, 5)) {
    node("text", { x: x(tick * divisor), y: bottom + 14, "text-anchor": "middle" }, svg, String(tick));
  }
  node("text", { x: right, y: height - 3, "text-anchor": "end" }, svg, words);
  node("text", { x: 2, y: height - 3 }, svg, unit);
  const line = (values, at = times) => values.map((value, i) => value === null ? "" : `${(values[i - 1] ?? null) === null ? "M" : "L"}${x(at[i]).toFixed(1)},${y(value).toFixed(1)}`).join("");
  for (const one of curves) {
    for (const [time, value] of one.dots) node("circle", { cx: x(time), cy: y(value), r: 2.2, fill: one.colour, "fill-opacity": 0.6 }, svg);
    if (one.truth) node("path", { d: line(one.truth), class: "curve truth", stroke: one.colour }, svg);
    node("path", { d: line(one.model, one.at), class: "curve", stroke: one.colour }, svg);
  }
  if (now !== null) node("line", { class: "now", x1: x(now), x2: x(now), y1: top, y2: bottom }, svg);
}

// Counts of values over [low, high], painted with a colour map; marks at the ends of the range of colours. isotherm: as the picture has it.
function drawHistogram(canvas, counts, low, high, range, colours, isotherm) {
  const width = canvas.width = canvas.clientWidth * devicePixelRatio || 1;
  const height = canvas.height = canvas.clientHeight * devicePixelRatio || 1;
  const context = canvas.getContext("2d"), most = Math.max(...counts, 1);
  const bar = 10 * devicePixelRatio;
  for (let x = 0; x < width; x++) {
    const value = low + (x + 0.5) / width * (high - low);
    const share = Math.min(Math.max((value - range[0]) / Math.max(range[1] - range[0], 1e-9), 0), 1);
    const j = 3 * Math.round(share * 255);
    const colour = isotherm.holds(value) ? MARKED.map((part) => 255 * part) : colours.subarray(j, j + 3);
    context.fillStyle = `rgb(${colour.join(" ")})`;
    const tall = Math.sqrt(counts[Math.min(Math.floor(x / width * counts.length), counts.length - 1)] / most) * (height - bar - 2);
    context.fillRect(x, height - bar, 1, bar);
    context.globalAlpha = value < range[0] || value > range[1] ? 0.35 : 0.85;
    context.fillRect(x, height - bar - 1 - tall, 1, tall);
    context.globalAlpha = 1;
  }
}
