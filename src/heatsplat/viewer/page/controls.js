// What people do: pointers on the picture, menus and buttons, keys.

class Controls {
  constructor(viewer) {
    this.viewer = viewer;
    this.pointers = new Map();  // those that are down, by their number
    this.alone = true;  // none came to the first one
    this.moved = this.pinch = 0;  // pixels: how far they went, how far two are apart
    this.clicks = [];  // the probes before each of the last two
  }

  listen() {
    const { viewer } = this;
    this.listenToPointers();
    this.listenToDivider();
    this.listenToMenus();
    this.listenToColours();
    this.listenToTime();
    this.listenToFiles();
    new ResizeObserver(() => viewer.request()).observe($("stage"));
    document.addEventListener("keydown", (event) => this.pressed(event));
  }

  // The picture -----------------------------------------------------------------------------------------------------

  listenToPointers() {
    const canvas = $("canvas"), { viewer } = this;
    canvas.onpointerdown = (event) => this.began(event);
    canvas.onpointermove = (event) => this.dragged(event);
    canvas.onpointerup = canvas.onpointercancel = (event) => this.ended(event);
    canvas.onpointerleave = () => { $("readout").hidden = true; };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.ondblclick = (event) => {
      Object.assign(viewer.probes, this.clicks[0]);  // its clicks pinned nothing
      viewer.request();
      const [px, py] = viewer.pixelAt(event.clientX, event.clientY), pixel = viewer.splats.weightsAt(viewer.camera, px, py);
      if (pixel.left < 0.9) viewer.target = viewer.camera.point(px, py, pixel.depth);
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      viewer.nearer(-event.deltaY / (event.deltaMode ? 3 : 60));
    }, { passive: false });
    canvas.onfocus = canvas.onblur = () => viewer.request();
  }

  began(event) {
    $("canvas").setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
    this.alone = this.pointers.size === 1;
    this.moved = 0;
    const { areas } = this.viewer, plain = this.alone && event.button === 0 && !event.shiftKey;
    if (!this.alone) areas.draft = null;
    this.viewer.dragging = !(plain && areas.begin(...this.viewer.pixelAt(event.clientX, event.clientY)));
    this.viewer.keyboard = false;
  }

  dragged(event) {
    const { viewer, pointers } = this, before = pointers.get(event.pointerId);
    if (!before) return viewer.hover(event.clientX, event.clientY);
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    this.moved += Math.hypot(dx, dy);
    pointers.set(event.pointerId, event);
    if (viewer.areas.draft) viewer.areas.extend(...viewer.pixelAt(event.clientX, event.clientY));
    else if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (this.pinch) viewer.nearer(Math.log(now / this.pinch) / 0.08);
      this.pinch = now;
    } else if (this.moved > 3) {
      if (event.buttons & 2 || event.shiftKey) viewer.move(-dx * 0.03, -dy * 0.03, 0);
      else viewer.turn(dx * 0.006, -dy * 0.006);
    }
    return undefined;
  }

  ended(event) {
    const { viewer } = this, { list, numbered } = viewer.probes;
    const known = this.pointers.delete(event.pointerId);
    this.pinch = 0;
    viewer.dragging = this.pointers.size > 0;
    const { draft } = viewer.areas;
    if (event.type === "pointercancel") viewer.areas.draft = null;
    if (known && event.type === "pointerup" && event.button === 0) {
      this.clicks = [...this.clicks.slice(-1), { list: [...list], numbered }];
      if (draft) viewer.areas.finish(this.moved > 3);
      else if (this.alone && this.moved <= 3) viewer.probes.pin(...viewer.pixelAt(event.clientX, event.clientY));
    }
    viewer.request();
  }

  listenToDivider() {
    const slide = (event) => {
      const box = $("canvas").getBoundingClientRect();
      this.viewer.state.split = Math.min(Math.max((event.clientX - box.left) / box.width, 0.02), 0.98);
      this.viewer.request();
    };
    $("divider").onpointerdown = (event) => {
      $("divider").setPointerCapture(event.pointerId);
      $("divider").onpointermove = slide;
    };
    $("divider").onpointerup = $("divider").onpointercancel = () => { $("divider").onpointermove = null; };
  }

  // Menus and buttons -----------------------------------------------------------------------------------------------

  listenToMenus() {
    const { viewer } = this;
    $("quantity").onchange = () => viewer.choose({ quantity: $("quantity").value });
    $("other").onchange = () => viewer.choose({ other: $("other").value });
    for (const input of document.querySelectorAll("input[name=how]")) input.onchange = () => viewer.choose({ how: input.value });
    for (const input of document.querySelectorAll("input[name=move]")) input.onchange = () => viewer.choose({ walk: input.value === "walk" });
    for (const input of document.querySelectorAll("input[name=tool]")) input.onchange = () => viewer.areas.choose(input.value);
    $("spots").onchange = () => viewer.choose({ spots: $("spots").checked });
    $("theme").onclick = () => viewer.theme();
    $("help").onclick = () => viewer.help();
    $("fold").onclick = () => viewer.fold(!document.body.classList.contains("folded"));
  }

  listenToColours() {
    const { viewer } = this;
    $("map").onchange = () => viewer.choose({ map: $("map").value });
    $("auto").onclick = () => {
      viewer.byHand = false;
      viewer.fit();
    };
    $("low").onchange = $("high").onchange = () => this.typedEnds();
    $("isotherm").onchange = () => viewer.isotherm.choose($("isotherm").value);
    $("isothermLow").onchange = $("isothermHigh").onchange = () => viewer.isotherm.typed();
  }

  typedEnds() {
    const { viewer } = this, typed = ["low", "high"].map((id) => $(id).value), log = viewer.attribute?.log;
    const [low, high] = typed.map((text) => log ? Math.log10(Number(text)) : Number(text));
    viewer.request();
    viewer.refused = true;  // the ends that hold are shown again
    if (typed.includes("")) return undefined;
    if (![low, high].every(Number.isFinite)) return viewer.say("Both ends of logarithmic colours must be above 0.");
    if (!(low < high)) return viewer.say("The lower end of the colours must be below the upper one.");
    viewer.refused = false;
    viewer.state.ranges[viewer.rangeName] = [low, high];
    viewer.byHand = true;
    return undefined;
  }

  listenToTime() {
    const { viewer } = this;
    $("time").oninput = () => viewer.setTime(Number($("time").value));
    $("otherTime").oninput = () => viewer.choose({ otherTime: Number($("otherTime").value) });
    $("play").onclick = () => viewer.play(!viewer.state.playing);
  }

  listenToFiles() {
    const { viewer } = this;
    $("save").onclick = () => viewer.picturePage().toBlob((blob) => viewer.keep(`${viewer.stem}.png`, blob));
    $("saveCamera").onclick = () => viewer.keep(`${viewer.stem}_camera.json`, new Blob([viewer.cameraFile()], { type: "application/json" }));
    $("curves").onclick = () => viewer.keep(`${viewer.stem}_probes.csv`, new Blob([viewer.probes.table()], { type: "text/csv" }));
    $("areasTable").onclick = () => viewer.keep(`${viewer.stem}_areas.csv`, new Blob([viewer.areas.table()], { type: "text/csv" }));
    this.listenToPrinter();
    $("run").onchange = () => $("run").files[0] && viewer.openRun($("run").files[0]);
    document.body.ondragover = (event) => event.preventDefault();
    document.body.ondrop = (event) => {
      event.preventDefault();
      if (event.dataTransfer.files[0]) viewer.openRun(event.dataTransfer.files[0]);
    };
  }

  // On paper everything is light, as long as it prints.
  listenToPrinter() {
    const { viewer } = this;
    let before = null;
    window.onbeforeprint = () => {
      before ??= document.documentElement.dataset.theme;
      viewer.theme("light");
      viewer.frame(performance.now());
      viewer.fillSheet();
    };
    window.onafterprint = () => {
      viewer.theme(before);
      before = null;
    };
    $("print").onclick = () => window.print();
  }

  // Keys ------------------------------------------------------------------------------------------------------------

  pressed(event) {
    const { viewer } = this, { target, key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
    const moves = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End"], presses = ["Enter", " "];
    const own = target.matches("[type=range]") ? moves : target.matches("[name=tool]") ? [...moves, " "] : target.matches("[type=radio]") ? [...moves, ...presses] : target.matches("input, button") ? presses : [];
    if (target.matches("input[type=number], select, textarea") || own.includes(key)) return;
    const far = event.shiftKey ? 4 : 1, turn = 0.06 * far;
    const actions = {
      ArrowLeft: () => viewer.turn(turn, 0), ArrowRight: () => viewer.turn(-turn, 0),
      ArrowUp: () => viewer.turn(0, -turn), ArrowDown: () => viewer.turn(0, turn),
      w: () => viewer.move(0, 0, far), s: () => viewer.move(0, 0, -far), a: () => viewer.move(-far, 0, 0), d: () => viewer.move(far, 0, 0),
      q: () => viewer.move(0, far, 0), e: () => viewer.move(0, -far, 0),
      "+": () => viewer.nearer(2), "=": () => viewer.nearer(2), "-": () => viewer.nearer(-2), _: () => viewer.nearer(-2),
      " ": () => viewer.play(!viewer.state.playing),
      ",": () => viewer.stepTime(-1), ".": () => viewer.stepTime(1), "<": () => viewer.stepTime(-10), ">": () => viewer.stepTime(10),
      ";": () => viewer.stepTime(-10), ":": () => viewer.stepTime(10),
      n: () => viewer.goTo((viewer.lastCamera ?? -1) + 1, true), p: () => viewer.goTo((viewer.lastCamera ?? 1) - 1, true),
      Enter: () => viewer.areas.tool === "point" ? viewer.probes.pin(...viewer.middle()) : viewer.areas.addInMiddle(),
      m: () => viewer.pick("box"), l: () => viewer.pick("line"), Escape: () => viewer.areas.choose("point"),
      Delete: () => viewer.removeLast(), Backspace: () => viewer.removeLast(),
      v: () => viewer.cycle("quantity", "quantity"), b: () => viewer.cycle("other", "other"),
      f: () => viewer.choose({ how: viewer.state.how === "swipe" ? "difference" : "swipe" }),
      "[": () => viewer.choose({ split: Math.max(viewer.state.split - 0.04, 0.02) }),
      "]": () => viewer.choose({ split: Math.min(viewer.state.split + 0.04, 0.98) }),
      c: () => viewer.cycle("map", "map"), r: () => viewer.fit(),
      i: () => viewer.isotherm.next(), x: () => viewer.choose({ spots: !viewer.state.spots }),
      o: () => {
        viewer.choose({ walk: !viewer.state.walk });
        viewer.say(viewer.state.walk ? "walk" : "orbit");
      },
      t: () => viewer.theme(), h: () => viewer.help(), "?": () => viewer.help(),
      "\\": () => viewer.fold(!document.body.classList.contains("folded")),
    };
    const action = actions[key.length === 1 ? key.toLowerCase() : key];
    if (!action) return;
    event.preventDefault();
    viewer.keyboard = true;
    action();
  }
}
