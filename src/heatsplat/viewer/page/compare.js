// A second run beside the first, from a page of its own.

const SAME_MOMENT_S = 1e-3;

// How many seconds later another run counts the same moment, from images that both know by name; null where these do not tell.
function laterIn(own, told) {
  const moments = ({ cameras, moments = [] }) => [...cameras.map((one) => [one.name, one.time]), ...moments].filter(([, time]) => time !== null);
  const known = new Map(moments(own));
  const apart = moments(told).filter(([name]) => known.has(name)).map(([name, time]) => time - known.get(name)).sort((a, b) => a - b);
  return apart.length && apart.at(-1) - apart[0] < SAME_MOMENT_S ? apart[apart.length >> 1] : null;
}

// What its page holds; an error where its values cannot be compared.
async function readRun(file, own) {
  const payload = await readPayload(new DOMParser().parseFromString(await file.text(), "text/html")), { unit } = payload.told;
  if (unit !== own.unit) throw new Error(`its values are in ${unit || "image values"}, these in ${own.unit || "image values"}`);
  return payload;
}

class SecondRun {
  constructor(payload, viewer) {
    this.told = payload.told;
    this.drawing = viewer.drawing;
    this.splats = new Splats(payload);
    this.scene = this.drawing.load(this.splats);
    this.sorter = new Sorter(this.splats, (ids) => {
      this.drawing.order(this.scene, ids);
      viewer.request();
    });
    const later = viewer.told.span && this.told.span ? laterIn(viewer.told, this.told) : 0;
    this.later = later ?? 0;
    this.ownClock = later === null;
  }

  get label() {
    return `run${this.ownClock ? " by its own clock" : ""}: ${this.told.method}, ${this.told.scene}`;
  }

  // Values of a quantity at a moment of the first run.
  fill(quantity, time) {
    this.splats.fill(this.splats.layer(quantity) || this.splats.layers[0], time + this.later, this.scene.filled, 0, 2);
    this.drawing.update(this.scene);
  }

  // The value of a pixel, from what was blended from the place j on; null where next to nothing was.
  valueOf(blended, j) {
    const alpha = blended[j + 3], [low, high] = this.told.tableEnds;
    if (alpha < 0.05) return null;
    return this.splats.decoded(alpha * low + blended[j] * (high - low) + (1 - alpha) * this.told.background);
  }
}
