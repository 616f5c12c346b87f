// A page that a run serves while it trains: newer states take the place of the one that is shown, and what people chose stays.

const ASK_MS = 2000;

class Live {
  constructor(viewer) {
    this.viewer = viewer;
    this.line = Object.assign(document.createElement("p"), { id: "live" });
    this.line.setAttribute("role", "status");
    this.line.style.cssText = "margin: 0; font-size: 12.5px; font-variant-numeric: tabular-nums; overflow: hidden; text-overflow: ellipsis; white-space: nowrap";
    $("facts").before(this.line);
    this.tell();
    document.addEventListener("visibilitychange", () => this.ask());
    this.ask();
  }

  get state() {
    return this.viewer.told.live.state;
  }

  // What is shown, and what is known of the run beyond that.
  tell(more = "") {
    const { step, steps, seconds, scores } = this.viewer.told.live, whole = (count) => Math.round(count).toLocaleString("en");
    const words = [more, `step ${whole(step)} of ${whole(steps)}`];
    if (typeof seconds === "number") words.push(`${seconds < 10 ? seconds.toFixed(1) : whole(seconds)} s`);
    this.line.textContent = [...words, scores].filter(Boolean).join(" · ");
    this.line.title = this.line.textContent;
  }

  // Asks for what is new, again and again; a page that nobody sees does not, and costs the run nothing.
  async ask() {
    clearTimeout(this.next);
    if (document.hidden || this.over || this.asking) return;
    this.asking = true;
    try {
      await this.look();
    } catch {
      this.tell("no answer: the run has ended, or cannot be reached");
    }
    this.asking = false;
    if (!this.over) this.next = setTimeout(() => this.ask(), ASK_MS);
  }

  async look() {
    const status = await (await fetch("status", { cache: "no-store" })).json();
    if (status.run !== this.viewer.told.live.run) {
      this.over = true;
      this.tell("another run trains at this address: reload the page to watch it");
      return;
    }
    if (status.state > this.state) {
      const text = await (await fetch(".", { cache: "no-store" })).text();
      await this.take(await readPayload(new DOMParser().parseFromString(text, "text/html")));
    }
    this.over = Boolean(status.phase);
    this.tell(status.phase || (status.problem ? `no newer state: ${status.problem}` : ""));
  }

  // Shows another state once its Gaussians are sorted; the old one stays until then.
  async take(payload) {
    const { viewer } = this, { drawing } = viewer, splats = new Splats(payload), scene = drawing.load(splats);
    const before = { sorter: viewer.sorter, scene: viewer.scene };
    let first;
    const sorted = new Promise((done) => { first = done; });
    const sorter = new Sorter(splats, (ids) => {
      drawing.order(scene, ids);
      first();
      viewer.request();
    });
    sorter.sort(viewer.camera);
    await sorted;
    Object.assign(viewer, { told: payload.told, splats, scene, sorter, pictureKey: null });
    before.sorter.stop();
    const { gl } = drawing;
    for (const name of ["places", "turns", "sizes", "values", "table", "colours"]) gl.deleteTexture(before.scene[name] || null);
    gl.deleteBuffer(before.scene.ids);
    gl.deleteVertexArray(before.scene.array);
    this.refresh(payload);
  }

  // The panel and what was measured, of the state that is shown now.
  refresh(payload) {
    const { viewer } = this, { state } = viewer, kept = document.documentElement.dataset.theme, folded = document.body.classList.contains("folded");
    viewer.cameras.forEach((one, i) => {
      const { added, ...entry } = payload.told.cameras[i];
      one.camera = Camera.of(entry);
      one.added = added ? added.map((part) => ({ name: part.name, values: inUnits(part, payload.array) })) : null;
    });
    const run = $("other").querySelector("[value=run]");
    for (const id of ["quantity", "other", "map", "parts", "cameras"]) $(id).replaceChildren();
    viewer.build();
    if (run) $("other").append(run);
    for (const input of $("parts").querySelectorAll("input")) input.checked = !viewer.off.has(input.parentElement.textContent.trim());
    document.documentElement.dataset.theme = kept;
    viewer.fold(folded);
    [...$("cameras").children].forEach((button, i) => button.setAttribute("aria-current", String(i === viewer.lastCamera)));
    const offered = (id, value) => [...$(id).options].some((option) => option.value === value);
    if (!offered("quantity", state.quantity)) state.quantity = "camera";  // gone, such as without a part that no longer changes anything
    if (!offered("other", state.other)) state.other = "nothing";
    for (const probe of viewer.probes.list) {
      probe.pixel = viewer.splats.weightsAt(probe.camera, probe.px, probe.py);
      if (probe.pixel.left < 0.9) probe.point = probe.camera.point(probe.px, probe.py, probe.pixel.depth);
      viewer.probes.measure(probe);
    }
    viewer.stale = { values: true, order: true };
    viewer.settled = false;
    viewer.request();
  }
}

const watching = setInterval(() => {  // the viewer starts once its payload is read
  if (!window.viewer) return;
  clearInterval(watching);
  window.live = new Live(window.viewer);
}, 50);
