// A second run beside the first, from a page of its own.

const SAME_MOMENT_S = 1e-3, SAME_PLACE = 0.02;  // of the size of the scene
const OTHER_DAY = "The second run was recorded at another time";
const OTHER_CLOCK = "Images do not tell how far the clocks of both runs are apart: each counts from its own first training image.";

// Whether both pages know the moment of their second 0, on the same kind of clock.
const shareClock = (own, told) => typeof own.start === "number" && typeof told.start === "number" && own.utc === told.utc;

// How many seconds later another run counts the same moment, from the clock where both know it, else from images that both know by
// name; null where these do not tell.
function laterIn(own, told) {
  if (shareClock(own, told)) return own.start - told.start;
  const moments = ({ cameras, moments = [] }) => [...cameras.map((one) => [one.name, one.time]), ...moments].filter(([, time]) => time !== null);
  const known = new Map(moments(own));
  const apart = moments(told).filter(([name]) => known.has(name)).map(([name, time]) => time - known.get(name)).sort((a, b) => a - b);
  return apart.length && apart.at(-1) - apart[0] < SAME_MOMENT_S ? apart[apart.length >> 1] : null;
}

// Why differences between two runs need not mean anything: sentences. Cameras of the same name stand in the same place and look at
// the same one where runs are of the same scene; where no names agree, extents tell.
function doubts(own, told) {
  const found = [], known = new Map(own.cameras.map((one) => [one.name, Camera.of(one)]));
  if (told.scene !== own.scene) found.push(`It is of another scene than this one, ${own.scene}.`);
  const away = told.cameras.filter(({ name }) => known.has(name)).map((entry) => {
    const here = known.get(entry.name), there = Camera.of(entry);
    const apart = (a, b) => length(plus(a, b, -1));
    return Math.max(apart(here.centre, there.centre), apart(plus(here.centre, here.forward, own.size), plus(there.centre, there.forward, own.size)));
  }).sort((a, b) => a - b);
  const apart = length(plus(own.centre, told.centre, -1)), [small, large] = [own.size, told.size].sort((a, b) => a - b);
  if (away.length ? away[away.length >> 1] > SAME_PLACE * own.size : apart > 0.5 * large || large > 2 * small) {
    found.push(`${away.length ? "Cameras of the same names stand elsewhere in it" : "It lies elsewhere"}: what is compared are different places.`);
  }
  return found;
}

// How many pixels of a run's images one of another run's is wide (trained at another data.downscale), by a camera that both know, else
// by the first of each.
function pixelIn(own, told) {
  const known = new Map(own.cameras.map((one) => [one.name, one])), there = told.cameras.find(({ name }) => known.has(name)) || told.cameras[0];
  return (known.get(there.name) || own.cameras[0]).intrinsics[0] / there.intrinsics[0];
}

// What its page holds; an error where its values cannot be compared.
async function readRun(file, own) {
  const payload = await readPayload(new DOMParser().parseFromString(await file.text(), "text/html")), { unit } = payload.told;
  if (unit !== own.unit) throw new Error(`its values are in ${unit || "image values"}, these in ${own.unit || "image values"}`);
  return payload;
}

// How much later something is, in words.
function daysAndHours(seconds) {
  const [amount, word] = Math.abs(seconds) < 2 * 86400 ? [seconds / 3600, "hours"] : [seconds / 86400, "days"];
  return `${Math.abs(amount).toFixed(1)} ${word} ${amount < 0 ? "earlier" : "later"}`;
}

class SecondRun {
  constructor(payload, viewer) {
    this.told = payload.told;
    this.drawing = viewer.drawing;
    this.splats = new Splats(payload);
    this.scene = this.drawing.load(this.splats);
    this.scene.pixel = pixelIn(viewer.told, this.told);
    this.sorter = new Sorter(this.splats, (ids) => {
      this.drawing.order(this.scene, ids);
      viewer.request();
    });
    this.setClock(viewer.told);
    this.doubts = doubts(viewer.told, this.told);
  }

  setClock(own) {
    const { span } = this.told, later = own.span && span ? laterIn(own, this.told) : 0;
    const apart = later !== null && span && own.span && (own.span[1] + later < span[0] || own.span[0] + later > span[1]);
    this.later = apart ? 0 : later ?? 0;
    this.clockNote = later === null ? OTHER_CLOCK : apart ? `${OTHER_DAY} (${daysAndHours(-later)}): each run counts from its own first training image.` : "";
  }

  get label() {
    return `run: ${this.told.method}, ${this.told.scene}`;
  }

  // What is said while it is compared: its name in full, its clock, and what speaks against comparing.
  get note() {
    return [`Second run: ${this.told.method}, ${this.told.scene}.`, this.clockNote, ...this.doubts].filter(Boolean).join(" ");
  }

  // Values of a quantity at a moment of the first run.
  fill(quantity, time) {
    this.layer = this.splats.layer(quantity) || this.splats.layers[0];
    this.splats.fill(this.layer, time + this.later, this.scene.filled, 0, 2);
    this.drawing.update(this.scene);
  }

  // Whether values are those of its image, which holds none outside of its range.
  get clamped() {
    return this.layer?.name === "camera";
  }

  // The value of a pixel, from what was blended from the place j on; null where next to nothing was.
  valueOf(blended, j) {
    const alpha = blended[j + 3];
    return alpha < 0.05 ? null : this.splats.valueOf(blended[j], alpha, this.layer);
  }
}
