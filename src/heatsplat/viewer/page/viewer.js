// The page: what is shown, and how one moves in it.

const $ = (id) => document.getElementById(id);
const AT_CAMERAS = "Images of cameras are known where and when they were taken: N and P go to the next.";
const BINS = 96, PLAY_LIMIT_MS = 45, DIFFERENCES = "RdBu_r";

class Viewer {
  constructor(payload) {
    this.told = payload.told;
    this.splats = new Splats(payload);
    this.drawing = new Drawing($("canvas"));
    this.scene = this.drawing.load(this.splats);
    this.run = null;  // a second one
    this.sorter = new Sorter(this.splats, (ids) => {
      this.drawing.order(this.scene, ids);
      this.request();
    });
    this.maps = Object.fromEntries(Object.entries(this.told.maps).map(([name, place]) => {
      const gl = this.drawing.gl, colours = payload.array(place);
      return [name, { colours, texture: this.drawing.texture(gl.RGB8, 256, 1, gl.RGB, gl.UNSIGNED_BYTE, colours, true) }];
    }));
    const { array } = payload, [low] = this.told.limits;
    this.cameras = this.told.cameras.map((entry) => ({ ...entry, camera: Camera.of(entry), size: entry.recorded.size,
      recorded: inUnits(entry.recorded, array).map((above) => above < 0 ? NaN : low + above), rgb: entry.rgb ? array(entry.rgb) : null,
      added: entry.added ? entry.added.map((part) => ({ name: part.name, values: inUnits(part, array) })) : null }));
    this.off = new Set();  // parts of the camera's model that are switched off
    this.state = { quantity: "camera", other: "nothing", how: "swipe", split: 0.5, map: "inferno", walk: false, playing: false, spots: false, at: 0,
      time: this.told.record ? (this.told.record[0] + this.told.record[1]) / 2 : 0, otherTime: this.told.record ? this.told.record[0] : 0, ranges: {}, isotherms: {} };
    this.probes = new Probes(this);
    this.areas = new Areas(this);
    this.isotherm = new Isotherm(this);
    this.camera = this.cameras[0].camera;
    this.target = this.told.centre;
    this.quality = 1;
    this.errors = [];
    this.stale = { values: true, order: true };
    this.build();
    new Controls(this).listen();
    this.goTo(0);
    this.fit();
    for (const point of this.told.probes) if (this.probes.list.length < 3) this.probes.pinPoint(point);
    this.request();
  }

  // What is there ---------------------------------------------------------------------------------------------------

  get layer() {
    return this.splats.layer(this.state.quantity);
  }

  get attribute() {
    return this.splats.attributes.find((one) => `learned ${one.name}` === this.state.quantity) || null;
  }

  get unit() {
    return this.attribute ? this.attribute.unit : this.told.unit;
  }

  get quantityName() {
    return ($("quantity").selectedOptions[0]?.text || "").replace(/^learned: /, "");
  }

  // What the picture shows, in words.
  get shownName() {
    const other = this.beside === "nothing" ? "" : `${this.differing ? " minus" : ", beside it"} ${$("other").selectedOptions[0].text}`;
    return `${this.quantityName}${other}`;
  }

  get range() {
    return this.state.ranges[this.rangeName] || [0, 1];
  }

  get rangeName() {
    return this.differing ? `difference ${this.state.other}` : this.attribute ? this.state.quantity : "values";
  }

  // What stands beside it, of which images of cameras are known at their places and times alone; nothing does beside what was learned.
  get beside() {
    return this.attribute || (this.ofCamera && !this.atImage) ? "nothing" : this.state.other;
  }

  // Whether this is the place and the time of the image of a training camera.
  get atImage() {
    const one = this.cameras[this.state.at], { span } = this.told;
    if (!one || !span || one.time === null) return Boolean(one);
    return Math.abs(one.time - this.state.time) <= 1e-6 * (span[1] - span[0]);
  }

  get ofCamera() {
    return this.state.other === "recorded" || this.state.other === "sensor";
  }

  get differing() {
    return this.beside !== "nothing" && this.beside !== "visible" && this.state.how === "difference" && this.layer !== null;
  }

  get mapName() {
    return this.differing ? DIFFERENCES : this.state.map;
  }

  // Where the image of the camera lies on the canvas, in its pixels.
  get view() {
    const { width, height } = $("canvas");
    const scale = Math.min(width / this.camera.width, height / this.camera.height);
    return { camera: this.camera, scale, left: (width - scale * this.camera.width) / 2, top: (height - scale * this.camera.height) / 2 };
  }

  build() {
    const option = (select, value, text) => select.append(new Option(text, value));
    const noun = this.told.unit ? "temperature" : "image value";
    for (const layer of this.splats.layers) {
      const alone = layer.name === "camera" && !this.splats.layer("surface");
      option($("quantity"), layer.name, alone ? noun : layer.name === "truth" ? `true ${noun}` : `${noun} ${layer.label}`);
    }
    for (const one of this.splats.attributes) option($("quantity"), `learned ${one.name}`, `learned: ${one.label}`);
    if (this.splats.colours) option($("quantity"), "visible", "visible light");
    option($("other"), "nothing", "nothing");
    if (this.told.span) option($("other"), "time", "another time");
    for (const layer of this.splats.layers) option($("other"), layer.name, layer.label);
    if (this.splats.colours) option($("other"), "visible", "visible light");
    option($("other"), "recorded", "recorded image");
    if (this.cameras.some((one) => one.added)) option($("other"), "sensor", "the model's recording");
    for (const { name } of this.cameras[0].added || []) $("parts").append(this.partSwitch(name));
    for (const name of Object.keys(this.maps)) if (name !== DIFFERENCES) option($("map"), name, name);
    $("timeBar").hidden = !this.told.span;
    if (this.told.span) for (const id of ["time", "otherTime"]) Object.assign($(id), { min: this.told.span[0], max: this.told.span[1] });
    this.cameras.forEach((one, i) => $("cameras").append(this.thumbnail(one, i)));
    const unit = this.told.unit || "image values", small = (value) => Number(value.toPrecision(2));
    const ranks = this.splats.layers.map((layer) => `${layer.coefficients.length} for ${layer.name}, ${small(layer.worst)} ${unit} (aim: ${small(layer.aim)})`).join("; ");
    const notes = [];
    if (this.told.span) {
      notes.push(`Time: each Gaussian's curve is a sum of shared ones. How many, and worst error of any Gaussian found: ${ranks}, `
        + `of all Gaussians at ${this.splats.layers[0].checks} moments at which nothing was fitted.`);
      notes.push(`Beyond the record: ${this.told.beyondRecord}.`);
    }
    notes.push(...this.told.leftOut);
    if (this.told.effects.length) notes.push(`Effects in the model: ${this.told.effects.join(", ").replaceAll("_", " ")}.`);
    notes.push(`Blended in ${this.drawing.exact.name}${this.drawing.exact === this.drawing.quicker ? "" : `, ${this.drawing.quicker.name} where frames come slowly while something moves`}. Probes are computed in double precision, from the pixel of the camera they were pinned in.`);
    $("notes").replaceChildren(...notes.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
    $("facts").textContent = `${this.splats.count.toLocaleString("en")} Gaussians`;
    const dark = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    document.documentElement.dataset.theme = dark;
    if (innerWidth <= 760) this.fold(true);
  }

  partSwitch(name) {
    const label = document.createElement("label"), input = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
    input.onchange = () => {
      this.off[input.checked ? "delete" : "add"](name);
      this.pictureKey = null;
      this.request();
    };
    label.append(input, ` ${name}`);
    return label;
  }

  // What the parts of the camera's model that are on add at a pixel of a training camera.
  addedAt(one, j) {
    return one.added.reduce((sum, part) => sum + (this.off.has(part.name) ? 0 : part.values[j]), 0);
  }

  thumbnail(one, i) {
    const button = document.createElement("button"), canvas = document.createElement("canvas");
    const [height, width] = one.size;
    Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d"), image = context.createImageData(width, height), { colours } = this.maps.inferno;
    let low = Infinity, high = -Infinity;
    for (const value of one.recorded) if (!Number.isNaN(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    const place = (value) => 3 * Math.round((Number.isNaN(value) ? 1 : (value - low) / Math.max(high - low, 1e-9)) * 255);
    one.recorded.forEach((value, j) => {
      const k = place(value);
      image.data.set(one.rgb ? [...one.rgb.subarray(3 * j, 3 * j + 3), 255] : [...colours.subarray(k, k + 3), 255], 4 * j);
    });
    if (one.rgb) for (let j = 0; j < one.recorded.length; j++) {  // heat on the left, light on the right
      if (j % width >= width / 2) continue;
      const k = place(one.recorded[j]);
      image.data.set([...colours.subarray(k, k + 3), 255], 4 * j);
    }
    context.putImageData(image, 0, 0);
    button.title = one.time === null ? one.name : `${one.name}, ${this.clock(one.time)}`;
    button.setAttribute("aria-label", `Camera ${i + 1}: ${button.title}`);
    button.onclick = () => this.goTo(i, true);
    button.append(canvas);
    return button;
  }

  clock(time) {
    if (!this.told.span) return "";
    const [divisor, word] = timeScale(this.told.span[1] - this.told.span[0]);
    return `${(time / divisor).toFixed(divisor === 1 ? 1 : 2)} ${word}`;
  }

  say(text) {
    $("message").textContent = text;
    clearTimeout(this.silence);
    this.silence = setTimeout(() => { $("message").textContent = ""; }, 3500);
  }

  // Moving ----------------------------------------------------------------------------------------------------------

  look(camera) {
    if (this.ofCamera && this.atImage) this.say(AT_CAMERAS);
    this.show(camera);
    this.state.at = null;
  }

  show(camera) {
    this.camera = camera;
    this.stale.order = true;
    this.request();
  }

  goTo(i, withTime = false) {
    const count = this.cameras.length, place = (i % count + count) % count, one = this.cameras[place];
    this.show(one.camera);
    this.state.at = place;
    this.lastCamera = place;
    if (withTime && one.time !== null) this.setTime(one.time);
    const pixel = this.splats.weightsAt(one.camera, one.camera.width / 2, one.camera.height / 2);
    if (pixel.left < 0.5) this.target = one.camera.point(one.camera.width / 2, one.camera.height / 2, pixel.depth);
    [...$("cameras").children].forEach((button, j) => button.setAttribute("aria-current", String(j === place)));
  }

  get pace() {
    const away = length(plus(this.camera.centre, this.target, -1));
    return 0.04 * (this.state.walk ? Math.min(away, this.told.size) : away);
  }

  turn(yaw, pitch) {
    const { walk } = this.state;
    const sign = walk ? -1 : 1;
    this.look(this.camera.rotated(-yaw * sign, pitch * sign, this.told.up, walk ? null : this.target));
  }

  move(right, down, forward) {
    const before = this.camera;
    this.look(before.moved(right * this.pace, down * this.pace, forward * this.pace));
    if (right || down) this.target = plus(plus(this.target, before.right, right * this.pace), before.down, down * this.pace);
  }

  nearer(steps) {
    if (this.state.walk) return this.move(0, 0, steps);
    const away = plus(this.camera.centre, this.target, -1);
    const factor = Math.exp(-0.08 * steps);
    if (length(away) * factor < 0.002 * this.told.size) return undefined;
    return this.look(this.camera.posed(this.camera.right, this.camera.down, this.camera.forward, plus(this.target, away, factor)));
  }

  // Time ------------------------------------------------------------------------------------------------------------

  setTime(time) {
    if (!this.told.span) return;
    const before = this.atImage;
    this.state.time = Math.min(Math.max(time, this.told.span[0]), this.told.span[1]);
    if (this.ofCamera && before && !this.atImage) this.say(AT_CAMERAS);
    this.stale.values = true;
    this.request();
  }

  stepTime(steps) {
    if (this.told.span) this.setTime(this.state.time + steps * (this.told.span[1] - this.told.span[0]) / 200);
  }

  play(on) {
    if (!this.told.span) return;
    this.state.playing = on;
    this.clockStart = null;
    if (on && this.state.time >= this.told.span[1]) this.setTime(this.told.span[0]);
    $("play").setAttribute("aria-label", on ? "Pause" : "Play");
    this.request();
  }

  // Drawing ---------------------------------------------------------------------------------------------------------

  request() {
    this.pending ||= requestAnimationFrame((now) => {
      this.pending = null;
      try {
        this.frame(now);
      } catch (error) {
        this.errors.push(String(error));
        throw error;
      }
    });
  }

  frame(now) {
    const since = now - (this.lastFrame || now);
    this.lastFrame = now;
    if (this.state.playing && this.clockStart !== null) {
      const [start, end] = this.told.span;
      const next = this.state.time + (now - this.clockStart) / 1000 * (end - start) / Number($("speed").value);
      this.setTime(next > end ? start : next);
    }
    if (this.state.playing) this.clockStart = now;
    if (since > 0 && since < 400 && (this.state.playing || this.dragging)) {
      this.pacing = this.pacing ? 0.9 * this.pacing + 0.1 * since : since;
      $("facts").textContent = `${this.splats.count.toLocaleString("en")} Gaussians · ${Math.round(1000 / this.pacing)} frames/s`;
      if (this.pacing > PLAY_LIMIT_MS) {  // coarser numbers first, then fewer pixels
        if (this.drawing.quick) this.quality = Math.max(0.5, this.quality - 0.1);
        else [this.drawing.quick, this.pacing] = [true, null];
      }
    }
    this.resize();
    if (this.stale.order) {
      this.sorter.sort(this.camera);
      if (this.run) this.run.sorter.sort(this.camera);
    }
    if (this.stale.values) this.fillValues();
    this.stale = { values: false, order: false };
    this.spots = null;
    this.paint();
    this.areas.measureAll(true);
    this.overlay();
    if (this.state.playing) this.request();
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.settle(), this.state.playing ? 600 : 180);
  }

  // Once nothing moves: full size, the histogram.
  settle() {
    if (!this.state.playing && !this.dragging && (this.quality < 1 || this.drawing.quick)) {
      this.quality = 1;
      this.drawing.quick = false;
      this.request();
      return;
    }
    this.histogram();
  }

  resize() {
    const canvas = $("canvas"), ratio = Math.min(devicePixelRatio, 2) * this.quality;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }

  fillValues() {
    const { splats, scene } = this, { other, time, otherTime } = this.state;
    const layer = this.layer;
    if (this.attribute) splats.fillAttribute(this.attribute, scene.filled);
    else if (layer) splats.fill(layer, time, scene.filled, 0, 2);
    const beside = splats.layer(other);
    if (other === "time" && layer) splats.fill(layer, otherTime, scene.filled, 1, 2);
    else if (beside && layer) splats.fill(beside, time, scene.filled, 1, 2);
    this.drawing.update(scene);
    if (this.run && other === "run") this.run.fill(this.state.quantity, time);
  }

  paint() {
    const { drawing, scene, state, view, told } = this, { width } = $("canvas");
    const other = this.beside;
    const picture = this.pictureBeside(other);
    const textures = { table: scene.table, map: this.maps[state.map].texture, differences: this.maps[DIFFERENCES].texture, picture };
    textures.first = drawing.blend(scene, view, "first").texture;
    if (other === "visible" || state.quantity === "visible") textures.visible = drawing.blend(scene, view, "visible", true).texture;
    if (other === "run" && this.run) {
      textures.second = drawing.blend(this.run.scene, view, "second").texture;
      textures.secondTable = this.run.scene.table;
    }
    const same = other === "time" || this.splats.layer(other) !== null;
    const kinds = { nothing: 0, run: 2, visible: 3, recorded: 4, sensor: 5 };
    const colour = getComputedStyle(document.documentElement).getPropertyValue("--paper").trim();
    const paper = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16) / 255);
    const behind = (one) => (one.background - one.tableEnds[0]) / (one.tableEnds[1] - one.tableEnds[0]);
    const attribute = this.attribute;
    drawing.show(textures, {
      ints: {
        kind: state.quantity === "visible" ? 2 : attribute ? 1 : 0,
        other: same ? 1 : kinds[other],
        difference: this.differing,
        marked: this.isotherm.ends !== null,
        clampFirst: state.quantity === "camera",
        clampSecond: other === "camera" || (other === "time" && state.quantity === "camera") || (other === "run" && this.run?.clamped),
      },
      floats: {
        range: this.differing ? [0, 1] : this.range,
        isotherm: (this.isotherm.ends || [0, 0]).map((end) => Math.min(Math.max(end, -3e38), 3e38)),
        spread: this.differing ? this.range : [-1, 1],
        limits: told.limits,
        limitsOfRun: this.run ? this.run.told.limits : told.limits,
        learned: attribute ? [attribute.low, attribute.high] : [0, 1],
        background: [behind(told), this.run ? behind(this.run.told) : 0],
        paper,
        frame: [view.left, view.top, view.scale * this.camera.width, view.scale * this.camera.height],
        split: other !== "nothing" && state.how === "swipe" || other === "visible" ? state.split * width : 1e9,
      },
    });
  }

  // The picture of the training camera where one stands: recorded values, or what the camera adds; where they are known.
  pictureBeside(other) {
    if (other !== "recorded" && other !== "sensor") return null;
    const one = this.state.at === null ? null : this.cameras[this.state.at];
    const gl = this.drawing.gl, key = `${other} ${this.state.at}`;
    if (this.pictureKey === key) return this.picture;
    if (this.picture) gl.deleteTexture(this.picture);
    this.pictureKey = key;
    this.picture = this.pictured = null;
    if (!one || (other === "sensor" && !one.added)) return null;
    const [rows, columns] = one.size;
    const content = new Float32Array(2 * rows * columns);
    for (let j = 0; j < rows * columns; j++) {
      const value = other === "sensor" ? this.addedAt(one, j) : one.recorded[j];
      content.set(Number.isNaN(value) ? [0, 0] : [value, 1], 2 * j);
    }
    this.pictured = { content, rows, columns };
    this.picture = this.drawing.texture(gl.RG32F, columns, rows, gl.RG, gl.FLOAT, content);
    return this.picture;
  }

  // What the picture of a training camera holds at a place of the canvas, pixels from the top left; null where nothing.
  picturedAt(x, y) {
    if (!this.pictured) return null;
    const { content, rows, columns } = this.pictured, { view } = this;
    const right = (x + 0.5 - view.left) / view.scale / this.camera.width, down = (y + 0.5 - view.top) / view.scale / this.camera.height;
    if (right < 0 || down < 0 || right >= 1 || down >= 1) return null;
    const k = 2 * (Math.floor(down * rows) * columns + Math.floor(right * columns));
    return content[k + 1] === 1 ? content[k] : null;
  }

  // Value that the pixel (x, y) of the canvas shows, from what was blended there, [value, second, -, alpha] from the place j on,
  // and what was of a second run where one is compared; null where next to nothing is.
  valueOf(blended, j, x, y, ofRun = null) {
    const alpha = blended[j + 3], { splats, told } = this;
    if (alpha < 0.02) return null;
    if (this.attribute) {
      const { low, high, log } = this.attribute, value = low + blended[j] / blended[j + 1] * (high - low);
      if (blended[j + 1] < MOSTLY * alpha) return null;
      return log ? 10 ** value : value;
    }
    const layer = this.layer;
    if (!layer) return null;
    const first = splats.valueOf(blended[j], alpha, layer);
    const other = this.beside;
    if (other === "nothing" || other === "visible" || (!this.differing && x <= this.state.split * $("canvas").width)) return first;
    let second;
    if (other === "recorded" || other === "sensor") {
      const seen = this.picturedAt(x, y);
      if (seen === null) return null;
      second = other === "recorded" ? seen : Math.min(Math.max(first + seen, told.limits[0]), told.limits[1]);
    } else if (other === "run") {
      second = ofRun ? this.run.valueOf(ofRun, j) : null;
      if (second === null) return null;
    } else second = splats.valueOf(blended[j + 1], alpha, other === "time" ? layer : splats.layer(other));
    return this.differing ? first - second : second;
  }

  // What was blended of a second run in a rectangle, where one is compared.
  blendedOfRun(x, y, width, height) {
    return this.beside === "run" && this.run && this.layer ? this.drawing.read("second", x, y, width, height) : null;
  }

  // Values of the picture, to fit colours to and to count.
  sampled() {
    const { width, height } = $("canvas");
    const content = this.drawing.read("first", 0, 0, width, height);
    if (!content) return [];
    const ofRun = this.blendedOfRun(0, 0, width, height);
    const stride = 4 * Math.max(1, Math.round(width * height / 60000)), found = [];
    for (let j = 0; j < content.length; j += stride) {
      const value = this.valueOf(content, j, j / 4 % width, height - 1 - Math.floor(j / 4 / width), ofRun);
      if (value !== null) found.push(this.attribute?.log ? Math.log10(value) : value);
    }
    return found;
  }

  // Colours from the picture: its hundredth lowest and highest value; about zero for a difference.
  fit() {
    this.resize();
    const ranges = this.state.ranges;
    const values = this.sampled().sort((a, b) => a - b);
    const share = (q) => values[Math.min(Math.floor(q * values.length), values.length - 1)];
    if (values.length < 20) {
      ranges[this.rangeName] ??= this.differing ? [-1, 1] : this.attribute ? [this.attribute.low, this.attribute.high] : [...this.told.limits];
    } else if (this.differing) {
      const most = Math.max(Math.abs(share(0.01)), Math.abs(share(0.99)), this.told.unit ? 0.05 : 0.001);
      ranges[this.rangeName] = [-most, most];
    } else {
      const [low, high] = [share(0.01), share(0.99)];
      ranges[this.rangeName] = high > low ? [low, high] : [low - 0.5, high + 0.5];
    }
    this.request();
  }

  histogram() {
    const values = this.sampled();
    this.areas.measureAll(false);
    this.areas.draw();
    if (!this.state.ranges[this.rangeName] || (!this.fitted && values.length > 100)) {
      this.fitted = true;
      this.fit();
    }
    const [low, high] = this.range, pad = 0.25 * (high - low);
    const counts = new Array(BINS).fill(0);
    for (const value of values) {
      const bin = Math.floor((value - low + pad) / (high - low + 2 * pad) * BINS);
      if (bin >= 0 && bin < BINS) counts[bin]++;
    }
    if (this.state.spots) this.spots = this.extremes();
    this.drawMarks();
    drawHistogram($("histogram"), counts, low - pad, high + pad, this.range, this.maps[this.mapName].colours, this.isotherm);
    this.isotherm.count(values);
    this.settled = true;
  }

  // The hottest and the coldest place of the picture, left of the divider where there is one: {x, y, value}, in canvas pixels.
  extremes() {
    if (this.state.quantity === "visible") return null;
    const { width, height } = $("canvas"), ofRun = this.blendedOfRun(0, 0, width, height), content = this.drawing.read("first", 0, 0, width, height);
    const step = Math.max(1, Math.round(Math.sqrt(width * height / 2e5)));
    const end = this.beside !== "nothing" && !this.differing ? this.state.split * width : width;
    let hot = null, cold = null;
    for (let y = 0; y < height; y += step) for (let x = 0; x < end; x += step) {
      const j = 4 * ((height - 1 - y) * width + x);
      if (!(content[j + 3] > SURFACE)) continue;
      const value = this.valueOf(content, j, x, y, ofRun);
      if (value === null) continue;
      if (!hot || value > hot.value) hot = { x, y, value };
      if (!cold || value < cold.value) cold = { x, y, value };
    }
    return hot && { hot, cold };
  }

  // Files to keep ----------------------------------------------------------------------------------------------------

  keep(name, blob) {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  get stem() {
    return `${this.told.scene}_${this.told.method}`.replace(/[^\w.-]+/g, "_");
  }

  // What the canvas shows, as a transforms.json of one camera in the world of the data: src/render.py makes the same picture of it.
  cameraFile() {
    const { camera, scale, left, top } = this.view, { width, height } = $("canvas"), [fx, fy, cx, cy] = camera.intrinsics;
    const origin = this.told.origin || [0, 0, 0], place = plus(camera.centre, origin);
    const rows = [0, 1, 2].map((i) => [camera.right[i], -camera.down[i], -camera.forward[i], place[i]]);  // OpenGL: y up, z back
    const frame = { file_path: `${this.stem}_camera.png`, transform_matrix: [...rows, [0, 0, 0, 1]] };
    if (this.told.span) frame.time_s = this.state.time;
    const lens = { w: width, h: height, fl_x: fx * scale, fl_y: fy * scale, cx: cx * scale + left, cy: cy * scale + top };
    return `${JSON.stringify({ camera_model: "PINHOLE", ...lens, frames: [frame] }, null, 2)}\n`;
  }

  // The picture with its marks and, below it, the scale and the time: a canvas.
  picturePage() {
    const shown = $("canvas"), ratio = shown.width / shown.clientWidth, page = document.createElement("canvas");
    const strip = Math.round(58 * ratio), style = getComputedStyle(document.body), ink = style.color;
    Object.assign(page, { width: shown.width, height: shown.height + strip });
    const context = page.getContext("2d");
    context.fillStyle = style.backgroundColor;
    context.fillRect(0, 0, page.width, page.height);
    context.drawImage(shown, 0, 0);
    context.font = `600 ${12 * ratio}px ${style.fontFamily}`;
    for (const one of $("marks").querySelectorAll("circle, text, .area")) {
      if (one.tagName === "path") {
        this.tracePath(context, one, ratio);
        continue;
      }
      const number = (key) => Number(one.getAttribute(key)) * ratio;
      [context.strokeStyle, context.lineWidth, context.fillStyle] = [one.tagName === "text" ? "#000b" : "#fff", 2 * ratio, "#fff"];
      if (one.tagName === "text") {
        context.textAlign = one.getAttribute("text-anchor") || "start";
        context.strokeText(one.textContent, number("x"), number("y"));
        context.fillText(one.textContent, number("x"), number("y"));
        continue;
      }
      context.beginPath();
      context.arc(number("cx"), number("cy"), number("r"), 0, 2 * Math.PI);
      if (one.getAttribute("fill")) {
        context.fillStyle = one.getAttribute("fill");
        context.fill();
      }
      context.stroke();
    }
    const top = shown.height, left = 14 * ratio, wide = Math.min(300 * ratio, page.width - 2 * left);
    context.fillStyle = ink;
    if (!$("legend").hidden) {
      context.drawImage($("bar"), left, top + 24 * ratio, wide, 10 * ratio);
      const words = [["barName", 0, 17, "start"], ["barLow", 0, 50, "start"], ["barMiddle", 0.5, 50, "center"], ["barHigh", 1, 50, "end"]];
      for (const [id, share, down, align] of words) {
        context.textAlign = align;
        context.fillText($(id).textContent, left + share * wide, top + down * ratio);
      }
    }
    context.textAlign = "end";
    const told = [document.title, this.told.span ? $("timeText").textContent : ""].filter(Boolean).join(" · ");
    if (page.width > 2 * wide) context.fillText(told, page.width - left, top + 17 * ratio);
    return page;
  }

  // What the printed report has beside probes, boxes and lines: the picture, what it shows and when, remarks.
  fillSheet() {
    const { told, isotherm } = this, { how } = isotherm.shown;
    $("sheetPicture").replaceChildren(this.picturePage());
    const shown = `${this.shownName}${this.unit ? ` (${this.unit})` : ""}`, lit = how === "none" ? "" : `green: ${isotherm.words}, ${$("isothermNote").textContent}`;
    const facts = [shown, told.span ? $("timeText").textContent : "", lit.replace(/, $/, ""), $("facts").textContent];
    $("sheetFacts").textContent = facts.filter(Boolean).join(" · ");
    $("sheetRemarks").textContent = $("remarks").value.trim();
  }

  // A path of the marks as SVG draws it, enlarged.
  tracePath(context, path, ratio) {
    const told = (key) => path.getAttribute(key), drawn = new Path2D(told("d"));
    context.save();
    context.scale(ratio, ratio);
    Object.assign(context, { strokeStyle: told("stroke"), lineWidth: Number(told("stroke-width")), fillStyle: told("fill"), globalAlpha: Number(told("stroke-opacity") ?? 1) });
    if (told("fill") !== "none") context.fill(drawn);
    context.stroke(drawn);
    context.restore();
  }

  // Controls follow the state ---------------------------------------------------------------------------------------

  overlay() {
    const { state, told } = this;
    $("quantity").value = state.quantity;
    $("other").value = state.other;
    $("map").value = state.map;
    for (const input of document.querySelectorAll("input[name=how]")) input.checked = input.value === state.how;
    for (const input of document.querySelectorAll("input[name=move]")) input.checked = (input.value === "walk") === state.walk;
    $("how").hidden = state.other === "nothing" || state.other === "visible" || this.layer === null;
    $("otherTimeRow").hidden = state.other !== "time";
    $("parts").hidden = state.other !== "sensor";
    $("runNote").hidden = state.other !== "run" || !this.run;
    $("runNote").textContent = this.run ? this.run.note : "";
    $("spots").checked = state.spots;
    const swiping = this.beside !== "nothing" && this.layer !== null && !this.differing;
    $("divider").hidden = !swiping;
    $("divider").style.left = `${100 * state.split}%`;
    if (told.span) {
      const beyond = state.time < told.record[0] || state.time > told.record[1];
      $("time").value = state.time;
      $("timeText").textContent = this.clock(state.time) + (beyond ? " · beyond the record" : "");
      $("time").setAttribute("aria-valuetext", $("timeText").textContent);
      $("otherTime").value = state.otherTime;
      $("otherTimeText").textContent = this.clock(state.otherTime);
      const share = (moment) => (moment - told.span[0]) / (told.span[1] - told.span[0]);
      for (const [id, moment] of [["time", state.time], ["otherTime", state.otherTime]]) {
        $(id).style.setProperty("--share", share(moment));
        $(id).style.setProperty("--from", `${100 * share(told.record[0])}%`);
        $(id).style.setProperty("--to", `${100 * share(told.record[1])}%`);
      }
    }
    const shown = (value) => this.attribute?.log ? 10 ** value : value;
    const digits = (value) => Number(shown(value).toPrecision(4)).toString();
    for (const [id, value] of [["low", this.range[0]], ["high", this.range[1]]]) {
      if (document.activeElement !== $(id) || this.refused) $(id).value = digits(value);
    }
    this.refused = false;
    $("legend").hidden = state.quantity === "visible";
    $("barLow").textContent = `≤ ${digits(this.range[0])}`;  // the last colours are those of all that lies beyond, too
    $("barMiddle").textContent = digits((this.range[0] + this.range[1]) / 2);
    $("barHigh").textContent = `≥ ${digits(this.range[1])}`;
    $("barName").textContent = (this.differing ? `minus ${$("other").selectedOptions[0].text}` : this.quantityName)
      + (this.unit ? `, ${this.unit}` : "") + (this.attribute?.log ? " (log)" : "");
    drawHistogram($("bar"), [0], this.range[0], this.range[1], this.range, this.maps[this.mapName].colours, this.isotherm);
    this.isotherm.draw();
    this.drawMarks();
    this.areas.draw();
    this.probes.draw();
  }

  drawMarks() {
    const svg = $("marks"), { view } = this, ratio = $("canvas").width / $("canvas").clientWidth || 1;
    svg.replaceChildren();
    const place = (point) => {
      const pixel = this.camera.project(point);
      return pixel && [(pixel[0] * view.scale + view.left) / ratio, (pixel[1] * view.scale + view.top) / ratio];
    };
    if (this.state.at === null) {
      for (const { camera } of this.cameras) {
        const size = 0.02 * this.told.size, far = size * camera.intrinsics[0] / camera.width;
        const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]].map(([x, y]) => place(camera.point(x, y, far)));
        const eye = place(camera.centre);
        if (!eye || corners.some((corner) => !corner)) continue;
        const path = `M${corners.map((corner) => corner.join()).join("L")}Z` + corners.map((corner) => `M${eye.join()}L${corner.join()}`).join("");
        node("path", { class: "frustum", d: path }, svg);
      }
    }
    this.probes.list.forEach((probe) => {
      const at = place(probe.point);
      if (!at) return;
      node("circle", { cx: at[0], cy: at[1], r: 6, fill: probe.colour, stroke: "#fff", "stroke-width": 2 }, svg);
      node("text", { x: at[0] + 10, y: at[1] + 4 }, svg, probe.name);
    });
    this.areas.mark(svg, ratio);
    for (const [name, mark] of Object.entries(this.spots || {})) {
      const x = (mark.x + 0.5) / ratio, y = (mark.y + 0.5) / ratio, near = x > $("canvas").clientWidth - 110;
      node("circle", { class: "spot", cx: x, cy: y, r: 7 }, svg);
      node("path", { class: "spot", d: `M${x - 11},${y}h6m10,0h6M${x},${y - 11}v6m0,10v6` }, svg);
      node("text", { x: x + (near ? -14 : 14), y: y + 4, "text-anchor": near ? "end" : "start" }, svg, `${name} ${this.words(mark.value)}`);
    }
    if (document.activeElement === $("canvas") && this.keyboard) {
      const x = $("canvas").clientWidth / 2, y = $("canvas").clientHeight / 2;
      node("path", { class: "cross", d: `M${x - 12},${y}h8m8,0h8M${x},${y - 12}v8m0,8v8` }, svg);
    }
  }

  // At the pointer --------------------------------------------------------------------------------------------------

  // Pixel of the camera's image at a place of the window.
  pixelAt(clientX, clientY) {
    const canvas = $("canvas"), box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width, { view } = this;
    return [((clientX - box.left) * ratio - view.left) / view.scale, ((clientY - box.top) * ratio - view.top) / view.scale];
  }

  // A value of the picture, with its unit.
  words(value) {
    return `${this.differing && value > 0 ? "+" : ""}${this.amount(value)}`;
  }

  amount(value) {
    const number = this.attribute ? Number(value.toPrecision(3)) : value.toFixed(this.unit ? 2 : 4);
    return `${number}${this.unit ? ` ${this.unit}` : ""}`;
  }

  hover(clientX, clientY) {
    const canvas = $("canvas"), box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
    const x = Math.floor((clientX - box.left) * ratio), y = Math.floor((clientY - box.top) * ratio);
    const readout = $("readout");
    const inside = x >= 0 && y >= 0 && x < canvas.width && y < canvas.height;
    const value = inside ? this.valueOf(this.drawing.read("first", x, y, 1, 1) || [0, 0, 0, 0], 0, x, y, this.blendedOfRun(x, y, 1, 1)) : null;
    readout.hidden = value === null;
    if (value === null) return;
    readout.textContent = this.words(value);
    const left = clientX - box.left, right = left > box.width - 110;
    readout.style.left = `${left + (right ? -100 : 14)}px`;
    readout.style.top = `${Math.max(clientY - box.top - 34, 4)}px`;
  }

  // What people do --------------------------------------------------------------------------------------------------

  choose(changes) {
    Object.assign(this.state, changes);
    this.stale.values = true;
    if (this.state.other === "run" && !this.run) this.state.other = "nothing";
    if ("other" in changes && this.ofCamera) {
      this.goTo(this.state.at ?? this.lastCamera ?? 0, true);
      this.say(AT_CAMERAS);
    }
    if (this.layer) this.probes.list.forEach((probe) => this.probes.measure(probe));
    const besideIt = "other" in changes && !this.byHand && (this.state.other === "time" || this.splats.layer(this.state.other));
    if (besideIt && this.layer && !this.differing) {  // colours for both sides
      this.frame(performance.now());
      this.fit();
    }
    if (!this.state.ranges[this.rangeName]) {
      this.state.ranges[this.rangeName] = this.differing ? [-1, 1] : this.attribute ? [this.attribute.low, this.attribute.high] : [...this.told.limits];
      this.frame(performance.now());
      this.fit();
    }
    this.request();
  }

  // A tool that draws on the picture, or a probe again.
  pick(tool) {
    this.areas.choose(this.areas.tool === tool ? "point" : tool);
    this.say(this.areas.tool === "point" ? "Click to pin a probe." : `Drag to draw a ${tool}; Enter puts one in the middle.`);
  }

  removeLast() {
    const since = ({ list }) => list.at(-1)?.since ?? -1;
    (since(this.areas) > since(this.probes) ? this.areas : this.probes).list.pop();
    this.request();
  }

  cycle(id, key) {
    const options = [...$(id).options].map((option) => option.value);
    this.choose({ [key]: options[(options.indexOf(this.state[key]) + 1) % options.length] });
    this.say(`${id === "other" ? "compare with: " : ""}${[...$(id).options].find((option) => option.value === this.state[key]).text}`);
  }

  fold(on) {
    document.body.classList.toggle("folded", on);
    $("fold").setAttribute("aria-expanded", String(!on));
    this.request();
  }

  theme(name = document.documentElement.dataset.theme === "dark" ? "light" : "dark") {
    document.documentElement.dataset.theme = name;
    this.request();
  }

  help() {
    $("keys").showModal();
    $("keys").scrollTop = 0;  // the button that has the focus is at its end
  }

  async openRun(file) {
    try {
      const payload = await readRun(file, this.told);
      if (this.run) this.run.sorter.stop();
      this.run = new SecondRun(payload, this);
      this.run.sorter.sort(this.camera);
      $("other").querySelector("[value=run]")?.remove();
      $("other").append(new Option(this.run.label, "run"));
      this.choose({ other: "run" });
      if (this.run.clockNote || this.run.doubts.length) this.say(this.run.note);
    } catch (error) {
      this.say(`${file.name} cannot be opened: ${error.message}`);
    }
  }

  // Pixel in the middle of the canvas.
  middle() {
    const { view } = this, { width, height } = $("canvas");
    return [(width / 2 - view.left) / view.scale, (height / 2 - view.top) / view.scale];
  }
}

readPayload(document)
  .then((payload) => { window.viewer = new Viewer(payload); })
  .catch((error) => {
    window.viewerFailed = String(error.stack || error);
    $("message").textContent = error.message;
  });
