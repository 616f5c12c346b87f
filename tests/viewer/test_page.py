"""viewer.html in a real browser: it loads, what it says agrees with the renderer, and the keyboard alone suffices."""

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from running import LOOKS, run
from viewer.browser import open_browser, opened, wait_until
from viewer.test_payload import in_units

from heatsplat.callbacks.viewer import ViewerPage
from heatsplat.contracts import SceneError, ViewSet, evenly_spread
from heatsplat.datamodules.listed_cameras import ListedCameras
from heatsplat.geometry.projection import to_world
from heatsplat.geometry.sight_lines import rays
from heatsplat.io.tables import read_csv
from heatsplat.preparation.regions import read_regions, region_of
from heatsplat.renderers.settings import Renderer
from heatsplat.runs.run import load
from heatsplat.viewer import page as pages
from heatsplat.viewer.page import FILE, write_viewer

ActionChains = pytest.importorskip(
    "selenium.webdriver", reason="selenium is not installed (pip install -e '.[dev]')"
).ActionChains

ROOT = Path(__file__).parents[2]
TINY = (
    "data.size=tiny", "callbacks.probes=null", "callbacks.images=null", "callbacks.costs.fps_repeats=1",
    "callbacks.surfaces.views=4", "callbacks.turntable.frames=3", "doctor=false", "threads=1", "optim.length_power=0", LOOKS,
)  # fmt: skip
USUAL = (800, 560)  # size of the window
SETTINGS = ("method=etgs", "max_steps=120", "thermal.frequencies=6")
REMEMBER = """window.asOpened = {state: structuredClone(viewer.state), told: {...viewer.told}, target: viewer.target,
  theme: document.documentElement.dataset.theme};"""
UNDO = """const v = viewer, {state, told, target, theme} = asOpened;
for (const key of Object.keys(v.told)) delete v.told[key];
Object.assign(v.told, told);
delete v.say;
document.getElementById('message').textContent = '';
document.documentElement.dataset.theme = theme;
document.activeElement.blur();
Object.assign(v, {state: structuredClone(state), run: null, spots: null, byHand: false, dragging: false, settled: false});
v.errors = [];
Object.assign(v.areas, {list: [], draft: null, tool: 'point', numbered: {box: 0, line: 0}});
Object.assign(v.probes, {list: [], reference: null, numbered: 0});
v.stale.values = true;
v.goTo(state.at);
v.target = target;
for (const point of told.probes) if (v.probes.list.length < 3) v.probes.pinPoint(point);"""
ALL = ("\ue009", "a", "\ue000")  # Control and A: what a field holds


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer") / "run"
    run(folder, *TINY, *SETTINGS)
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    return load(folder / "checkpoints" / "last.ckpt")


@pytest.fixture(scope="module")
def browser():
    browser = open_browser(*USUAL)
    yield browser
    browser.quit()


@pytest.fixture
def new_page(browser, folder):
    """The page, opened anew: for tests that change what was read from the file."""
    return opened(browser, folder / FILE)


@pytest.fixture
def page(browser, folder):
    """The page as it is when it has been opened; what the test before did with it is undone, which takes less time."""
    if browser.execute_script("return window.asOpened === undefined"):
        opened(browser, folder / FILE)
        browser.execute_script(REMEMBER)
    else:
        browser.execute_script(UNDO)
        wait_until(browser, "viewer.settled && !viewer.pending && !viewer.sorter.busy && !viewer.stale.order")
    return browser


def pixels(page) -> np.ndarray:
    """What the canvas shows, RGB of every eighth pixel or so."""
    script = """viewer.frame(performance.now()); const gl = viewer.drawing.gl, c = gl.canvas;
    const found = new Uint8Array(4 * c.width * c.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, found);
    return Array.from({length: Math.floor(found.length / 268)}, (_, i) => [0, 1, 2].map((k) => found[268 * i + k]));"""
    return np.array(page.execute_script(script), dtype=float)


def parts_of(path: Path) -> tuple[dict, bytes]:
    """The header of a page and its block."""
    text = path.read_text(encoding="utf-8")
    header, packed = (re.search(rf'id="{name}">(.*?)</script>', text, re.S)[1] for name in ("header", "block"))
    return json.loads(header), zlib.decompress(base64.b64decode(packed))


def keys(page, *pressed):
    page.execute_script("document.getElementById('canvas').focus()")
    ActionChains(page).send_keys(*pressed).perform()


def test_it_is_one_file_that_asks_for_nothing_else(folder):
    text = (folder / FILE).read_text(encoding="utf-8")
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "") and "https://" not in text
    assert "{{" not in text and "src=" not in text
    assert (folder / FILE).stat().st_size < 3e6


def test_it_loads_without_an_error_and_shows_the_scene(page):
    assert page.execute_script("return viewer.errors") == []
    assert [entry for entry in page.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert pixels(page).std(axis=0).max() > 20
    assert "Gaussians" in page.find_element("id", "facts").text
    assert "worst error" in page.find_element("id", "notes").get_attribute("textContent")


def test_the_report_is_one_page_with_all_its_pictures(browser, folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*\.(?:png|webp|js|css)"', text)
    browser.get((folder / "report.html").as_uri())
    names = wait_until(
        browser,
        "[...document.images].every((i) => i.complete && i.naturalWidth > 0) && [...document.images].map((i) => i.alt)",
    )
    assert {"the scene, turning", "numbered surfaces", "scores", "maps of learned quantities"} <= set(names)
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    titles = [title.text for title in browser.find_elements("css selector", "h2, summary")]
    assert {"Hottest and coldest surfaces", "Learned quantities", "How to cite", "Scores and cost"} <= set(titles)
    assert "m²" in browser.page_source and "Zhongwen Wang" in browser.page_source
    assert all(link.startswith("#") or (folder / link).exists() for link in re.findall(r'<a href="([^"]*)"', text))
    browser.set_window_size(390, 800)
    try:
        assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    finally:
        browser.set_window_size(*USUAL)
    learned = {row["name"]: row for row in read_csv(folder / "learned.csv")}
    assert learned["time constant"]["unit"] == "s" and learned["source"]["unit"] == "°C/h"
    assert all(row["low"] <= row["median"] <= row["high"] for row in learned.values())
    hot, *_, cold = read_csv(folder / "surfaces.csv")
    assert hot["kind"] == "hottest" and cold["kind"] == "coldest" and hot["mean_c"] > cold["mean_c"] and hot["area"] > 0


def test_the_small_page_of_the_readme_opens(browser):
    page = opened(browser, ROOT / "docs" / "pictures" / "heated_viewer.html")
    assert "5,652 Gaussians" in page.execute_script("return document.body.innerText")


def test_images_of_cameras_are_kept_to_half_a_step_and_masked_pixels_are_told(trained, tmp_path):
    scene = trained.module.scene
    mask = torch.ones(scene.train[0].thermal.shape[:2])
    mask[:9, :13] = 0
    masked = replace(scene, train=ViewSet(scene.train.frames, lambda i: replace(scene.train[i], mask=mask)))
    trained.module.scene = masked
    try:
        header, block = parts_of(write_viewer(trained.module, tmp_path / FILE, cameras=2))
    finally:
        trained.module.scene = scene
    told = header["cameras"][0]["recorded"]
    found = in_units(block, told).reshape(told["size"])
    expected = scene.train[0].thermal[..., 0] * (header["limits"][1] - header["limits"][0])
    assert told["step"] == 0.05 and (found[:9, :13] < 0).all()
    seen = mask.numpy() > 0
    np.testing.assert_allclose(found[seen], expected.numpy()[seen], atol=0.0251)


def test_a_page_with_fewer_cameras_is_smaller_and_none_is_refused(trained, folder, tmp_path):
    path = write_viewer(trained.module, tmp_path / FILE, cameras=3)
    header, _ = parts_of(path)
    names = [frame.name for frame in trained.module.scene.train.frames]
    assert [camera["name"] for camera in header["cameras"]] == [names[i] for i in evenly_spread(len(names), 3)]
    assert path.stat().st_size < (folder / FILE).stat().st_size
    for refused in (lambda: write_viewer(trained.module, tmp_path / FILE, cameras=0), lambda: ViewerPage(cameras=0)):
        with pytest.raises(SceneError, match="cameras must be a whole number, 1 or more.*got 0"):
            refused()


def test_probes_agree_with_the_renderer_at_ten_points_and_three_times(page, trained):
    """A click where the centre of a pixel lies, against ``src/render.py``'s image; the cursor's value too."""
    scene = trained.scene
    place = 1
    frame = scene.train.frames[evenly_spread(len(scene.train), 36)[place]]
    start, end = min(scene.train.times_s), max(scene.train.times_s)
    page.execute_script(f"viewer.probes.list = []; viewer.goTo({place}); viewer.frame(performance.now())")
    height, width = frame.camera.height, frame.camera.width
    points = [(int(width * x), int(height * y)) for x in (0.15, 0.35, 0.5, 0.65, 0.85) for y in (0.4, 0.7)]
    click = """const [x, y] = arguments, v = viewer.view, c = document.getElementById('canvas'), box = c.getBoundingClientRect();
    const ratio = c.width / box.width, at = {clientX: box.left + (x * v.scale + v.left) / ratio,
      clientY: box.top + (y * v.scale + v.top) / ratio, pointerId: 1, button: 0, bubbles: true};
    c.setPointerCapture = () => {};
    viewer.probes.list = [];
    c.dispatchEvent(new PointerEvent('pointerdown', at));
    c.dispatchEvent(new PointerEvent('pointerup', at));
    const probe = viewer.probes.list[0];
    return probe && viewer.splats.seriesAt(probe.pixel, probe.layer, arguments[2]);"""
    cursor = """const [x, y] = arguments, v = viewer.view;
    const cx = Math.floor(x * v.scale + v.left), cy = Math.floor(y * v.scale + v.top);
    const at = [cx + 0.5 - v.left, cy + 0.5 - v.top].map((place) => place / v.scale), layer = viewer.layer;
    return [viewer.valueOf(viewer.drawing.read('first', cx, cy, 1, 1), 0, cx, cy),
      viewer.splats.seriesAt(viewer.splats.weightsAt(viewer.camera, ...at), layer, [viewer.state.time])[0]];"""
    times = [start, 0.4 * start + 0.6 * end, end]
    found = [page.execute_script(click, x + 0.5, y + 0.5, times) for x, y in points]
    for i, time_s in enumerate(times):
        image = trained.render(frame, time_s, unseen="keep")
        expected = [image[y, x].item() for x, y in points]
        assert np.ptp(expected) > 1.0  # degrees: the points are not all alike
        assert [values[i] for values in found] == pytest.approx(expected, abs=0.1)
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    page.execute_script(f"viewer.setTime({times[1]}); viewer.frame(performance.now())")
    for x, y in points:  # what the cursor reads: the canvas's own pixel, in single precision
        blended, exact = page.execute_script(cursor, x + 0.5, y + 0.5)
        assert blended == pytest.approx(exact, abs=0.1)


def test_visible_light_is_as_transparent_as_heat_of_the_same_opacities(new_page):
    """Thin Gaussians, which a pixel that averages over its area makes fainter; the renderer does so in every modality."""
    heat, light = new_page.execute_script("""const v = viewer, s = v.splats, {width, height} = v.drawing.gl.canvas;
      s.scales = s.scales.map((scale) => 0.25 * scale);
      Object.assign(s, {colours: new Uint8Array(3 * s.count).fill(200), colourOpacities: s.opacities});
      const scene = Object.assign(v.drawing.load(s), {ids: v.scene.ids, array: v.scene.array, seen: v.scene.seen, ready: true});
      return [['first', false], ['visible', true]].map(([name, coloured]) => {
        v.drawing.blend(scene, v.view, name, coloured);
        return Array.from(v.drawing.read(name, 0, 0, width, height).filter((_, i) => i % 4 === 3));
      });""")
    assert new_page.execute_script("return viewer.told.renderer.antialiased") is True
    assert 0.02 < np.mean(heat) < 0.9
    np.testing.assert_allclose(light, heat, atol=1e-6)


def test_gaussians_are_as_wide_as_the_renderer_draws_them_on_pixels_of_any_size(page, trained, monkeypatch):
    """Beside a pixel of a training image lie ``finer`` of those that training rendered, and ``scale`` of the canvas."""
    asked, camera = [], trained.scene.train.frames[0].camera
    monkeypatch.setattr("heatsplat.renderers.settings.rasterization", lambda *_, eps2d, **__: asked.append(eps2d))
    sizes = [(finer, scale) for finer in (1, 4) for scale in (0.3, 0.5, 1.0, 3.0, 4.0) if scale <= finer]
    for settings in ({"eps2d": 1 / 12, "antialiased": True}, {"eps2d": 0.3, "antialiased": False}):
        renderer = Renderer("cpu", **settings)
        shapes = [torch.zeros(1, 3), torch.zeros(1, 4), torch.ones(1, 3), torch.ones(1, 1), torch.zeros(1, 1)]
        for finer, scale in sizes:
            renderer(*shapes, camera, None, (1,), ratio=finer / scale)
        script = "return arguments[1].map(([finer, scale]) => blurOn({...arguments[0], finer}, scale));"
        assert page.execute_script(script, settings, sizes) == pytest.approx(asked, rel=1e-9)
        asked.clear()
    assert page.execute_script("return blurOn({eps2d: 0.3, antialiased: false}, 2)") == pytest.approx(
        1.2
    )  # an older page


def test_the_slider_changes_the_picture(page):
    before = pixels(page)
    slider = page.find_element("id", "time")
    page.execute_script("arguments[0].value = arguments[0].max; arguments[0].dispatchEvent(new Event('input'))", slider)
    assert np.abs(pixels(page) - before).mean() > 2
    assert page.find_element("id", "timeText").text


def test_the_keyboard_alone_suffices(page):
    state = lambda: page.execute_script(  # noqa: E731
        "return [viewer.camera.centre.join(), viewer.state.time, viewer.state.other, viewer.state.map, viewer.probes.list.length,"
        " document.documentElement.dataset.theme, viewer.state.playing, viewer.lastCamera, viewer.state.walk]"
    )
    page.execute_script("document.getElementById('canvas').focus(); viewer.probes.list = []")
    seen = [state()]
    steps = [
        ("\ue012", 0), ("w", 0), (".", 1), ("b", 2), ("c", 3), ("\ue007", 4), ("t", 5), ("n", 7), ("o", 8),
    ]  # fmt: skip
    for key, changes in steps:
        keys(page, key)
        seen.append(state())
        assert seen[-1][changes] != seen[-2][changes], key
    keys(page, " ")
    wait_until(page, "viewer.state.playing")
    keys(page, " ")
    assert state()[6] is False
    keys(page, "h")
    assert wait_until(page, "document.getElementById('keys').open")
    ActionChains(page).send_keys("\ue00c").perform()  # Escape
    assert wait_until(page, "!document.getElementById('keys').open")
    missing = {"canvas", "quantity", "other", "map", "low", "high", "auto", "run", "time", "play", "speed"}
    page.execute_script(
        "const reached = window.reached = new Set(); addEventListener('focusin', (event) => reached.add(event.target.id))"
    )
    ActionChains(page).send_keys(80 * "\ue004").perform()  # Tab
    assert missing <= set(page.execute_script("return [...reached]"))
    assert page.execute_script("return viewer.errors") == []


def test_everything_beside_it_draws(page):
    others = page.execute_script("return [...document.getElementById('other').options].map((one) => one.value)")
    assert {"nothing", "time", "truth", "recorded"} <= set(others)
    page.execute_script("viewer.goTo(0, true)")
    for other in others[1:]:
        page.execute_script(f"viewer.choose({{other: '{other}', how: 'difference'}})")
        difference = pixels(page)
        page.execute_script("viewer.choose({how: 'swipe'})")
        assert np.abs(pixels(page) - difference).mean() > 1, other
    assert page.execute_script("return viewer.errors") == []


def test_coarser_numbers_while_frames_come_slowly_and_exact_ones_at_rest(page):
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    values = "viewer.frame(performance.now()); return viewer.sampled()"
    exact = np.array(page.execute_script(values))
    kind = "viewer.drawing.targets.first.kind === viewer.drawing.quicker"
    quick, is_quick = page.execute_script(
        f"viewer.drawing.quick = true; {values.replace('return ', 'return [')}, {kind}]"
    )
    assert is_quick
    span = np.ptp(page.execute_script("return viewer.told.limits"))
    assert 0 < np.abs(np.array(quick) - exact).max() < 0.01 * span
    wait_until(page, "!viewer.drawing.quick && viewer.drawing.targets.first.kind === viewer.drawing.exact")
    assert np.array(page.execute_script(values)) == pytest.approx(exact)


def test_frames_that_come_slowly_cost_numbers_first_and_then_pixels(page):
    """A clock that runs as on a slow computer, without waiting for it."""
    found = page.execute_script("""const v = viewer, told = [];
      v.dragging = true; v.pacing = null; v.lastFrame = 1000;
      for (let i = 1; i < 4; i++) {
        v.frame(1000 + 100 * i);
        told.push([v.drawing.quick, v.quality]);
      }
      v.dragging = false;
      return told;""")
    assert found[0] == [True, 1] and found[1][1] < 1 and found[2][1] < found[1][1]
    wait_until(page, "!viewer.drawing.quick && viewer.quality === 1")


def test_the_hottest_and_the_coldest_spot_are_those_of_the_picture(page):
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order && !viewer.pending")
    keys(page, "x")
    hot, cold = wait_until(page, "viewer.spots && [viewer.spots.hot, viewer.spots.cold]")
    values = page.execute_script("return viewer.sampled()")
    assert hot["value"] == pytest.approx(max(values), abs=0.5) and hot["value"] > np.quantile(values, 0.99)
    assert cold["value"] < np.quantile(values, 0.05)
    shown = page.execute_script("return [...document.querySelectorAll('#marks text')].map((one) => one.textContent)")
    assert f"hot {hot['value']:.2f} °C" in shown and f"cold {cold['value']:.2f} °C" in shown
    keys(page, "x")
    wait_until(page, "document.querySelectorAll('#marks .spot').length === 0")  # by the next frame


def test_spots_of_what_was_learned_are_those_of_the_whole_picture(page):
    """Nothing stands beside it, so that there is no divider either."""
    page.execute_script("viewer.goTo(0); viewer.choose({quantity: 'learned time_constant_s', other: 'nothing'})")
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    found = page.execute_script("""const v = viewer, told = [];
      for (const other of ['nothing', 'time']) {
        v.choose({other, how: 'swipe', split: 0.05}); v.frame(performance.now());
        told.push([v.extremes(), v.shownName]);
      }
      return told;""")
    assert found[0] == found[1] and found[0][1] == "time constant"


def test_an_isotherm_paints_what_lies_in_it_and_tells_how_much(page):
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order && !viewer.pending")
    page.execute_script("viewer.isotherm.choose('above'); viewer.areas.tool = 'box'; viewer.areas.addInMiddle()")
    wait_until(page, "document.getElementById('isothermNote').textContent")
    low, high = page.execute_script("return viewer.range")
    assert page.execute_script("return viewer.isotherm.ends[0]") == pytest.approx(low + 0.75 * (high - low))
    painted = """viewer.frame(performance.now());
      const shown = document.getElementById('canvas'), page = viewer.picturePage().getContext('2d');
      const bytes = page.getImageData(0, 0, shown.width, shown.height).data, wanted = MARKED.map((part) => 255 * part);
      let count = 0, known = 0;
      for (let j = 0; j < bytes.length; j += 4) count += wanted.every((part, i) => Math.abs(bytes[j + i] - part) < 4);
      return [count / viewer.sampled().length, viewer.isotherm.share(viewer.sampled())];"""
    values = np.array(page.execute_script("return viewer.sampled()"))
    for how, shares in (("above", (0.7, 1)), ("between", (0.3, 0.6)), ("below", (0, 0.4))):
        ends = np.quantile(values, shares) + np.array([-1, 1]) * (np.array(shares) == [0, 1])  # nothing lies beyond
        page.execute_script(
            "viewer.isotherm.choose(arguments[0]); viewer.isotherm.shown.ends = arguments[1]", how, ends.tolist()
        )
        seen, told = page.execute_script(painted)
        assert told == pytest.approx(((values >= ends[0]) & (values <= ends[1])).mean())
        assert told == pytest.approx(shares[1] - shares[0], abs=0.02) and seen == pytest.approx(told, abs=0.02), how
    page.execute_script("viewer.isotherm.shown.ends = [-Infinity, viewer.isotherm.ends[1]]")
    words = page.execute_script("viewer.isotherm.draw(); return viewer.isotherm.words")
    assert words == f"below {ends[1]:.4g} °C"
    header, row = page.execute_script("return viewer.areas.table()").strip().split("\n")
    assert header.endswith(f'"{words} (%)"') and 0 <= float(row.split(",")[-1]) <= 100
    field = page.find_element("id", "isothermHigh")
    field.send_keys(*ALL, "30", "\ue007")
    wait_until(page, "viewer.isotherm.ends[1] === 30")
    before = page.execute_script("viewer.isotherm.choose('between'); return viewer.isotherm.ends")
    assert before[0] == 30
    field.send_keys(*ALL, "-300", "\ue007")
    wait_until(page, "document.getElementById('message').textContent.includes('below the upper')")
    assert page.execute_script("return viewer.isotherm.ends") == before
    page.execute_script("document.activeElement.blur()")
    keys(page, "i")
    wait_until(page, "viewer.isotherm.shown.how === 'none' && document.getElementById('isothermEnds').hidden")
    assert page.execute_script(painted)[0] == 0
    page.execute_script("viewer.choose({quantity: 'learned time_constant_s'}); viewer.isotherm.choose('below')")
    assert page.execute_script("return viewer.isotherm.words").startswith("below ")
    page.execute_script("viewer.choose({quantity: 'camera'})")
    assert page.execute_script("return viewer.isotherm.shown.how") == "none"  # each kind of value has its own


def test_curves_and_the_picture_can_be_kept(page):
    page.execute_script("viewer.probes.list = []; viewer.goTo(0); viewer.probes.pin(...viewer.middle())")
    head, *rows = page.execute_script("return viewer.probes.table()").strip().split("\n")
    assert head.startswith("time (s),probe ") and head.split(",")[2].endswith("truth (°C)")
    told = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    point = page.execute_script("return viewer.probes.list[0].point")
    assert [name[-1] for name in head.split(",")[3:]] == ["x", "y", "z"]
    assert told[:, 3:] == pytest.approx(np.tile(point, (len(told), 1)))
    told = told[:, :3]
    series = "const p = viewer.probes.list[0]; return [viewer.probes.times, p.model, p.truth]"
    assert np.abs(told.T - np.array(page.execute_script(series))).max() < 6e-4
    kept = page.execute_script("""viewer.frame(performance.now());
      const kept = viewer.picturePage(), shown = document.getElementById('canvas');
      const one = kept.getContext('2d').getImageData(0, 0, shown.width, shown.height).data;
      return [kept.width - shown.width, kept.height - shown.height, new Set(one).size];""")
    assert kept[0] == 0 and kept[1] > 20 and kept[2] > 50


def test_a_report_is_printed_on_light_paper_with_what_is_measured(page):
    page.execute_script("""viewer.goTo(0); viewer.theme("dark"); viewer.isotherm.choose("above"); viewer.areas.tool = "box";
      viewer.areas.addInMiddle(); viewer.areas.tool = "point"; viewer.probes.pin(...viewer.middle());""")
    wait_until(page, "viewer.settled && $('isothermNote').textContent")
    page.find_element("id", "remarks").send_keys(
        "r of a wall\nfrom the door"
    )  # r fits the colours, where nothing is typed
    page.execute_script("""window.found = null;
      const restore = window.onafterprint;
      window.onafterprint = () => {
        const drawn = $("sheetPicture").firstChild, shown = $("canvas"), { theme } = document.documentElement.dataset;
        window.found = { theme, facts: $("sheetFacts").textContent, said: $("sheetRemarks").textContent,
          more: [drawn.width - shown.width, drawn.height - shown.height] };
        restore();
      };""")
    settings = {"printBackground": False, "paperWidth": 8.27, "paperHeight": 11.69}
    printed = base64.b64decode(page.execute_cdp_cmd("Page.printToPDF", settings)["data"])
    found = wait_until(page, "window.found")
    assert printed.startswith(b"%PDF")
    assert found["theme"] == "light" and page.execute_script("return document.documentElement.dataset.theme") == "dark"
    assert found["said"] == "r of a wall\nfrom the door" and found["more"][0] == 0 and found["more"][1] > 20
    words = page.execute_script("return [viewer.shownName, $('timeText').textContent, viewer.isotherm.words]")
    assert all(word and word in found["facts"] for word in words)
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    seen = page.execute_script(
        "return ['sheetPicture', 'probes', 'areas', 'chart', 'stage', 'timeBar', 'cameras', 'print', 'quantity']"
        ".filter((id) => $(id).checkVisibility())"
    )
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert seen == ["sheetPicture", "probes", "areas", "chart"]
    assert not page.execute_script("return $('sheetPicture').checkVisibility()")


def test_the_camera_can_be_kept_and_rendered(page, trained, tmp_path):
    """It has the pixels of the canvas."""
    told = page.execute_script("""viewer.goTo(0); viewer.turn(0.3, 0.1); viewer.nearer(1);
      viewer.setTime(0.4 * viewer.told.span[1]);
      viewer.told.origin = [5e5, 4e6, 0];
      const kept = [], keep = viewer.keep;
      viewer.keep = (name, blob) => kept.push(name);
      document.getElementById("saveCamera").click();
      viewer.keep = keep;
      const file = viewer.cameraFile();
      viewer.told.origin = null;
      const { camera, scale, left, top } = viewer.view, { width, height } = document.getElementById("canvas");
      const at = [0.3, 0.6].map((share) => [share * width, share * height]);
      return [kept, file, at,
        at.map(([x, y]) => camera.point((x - left) / scale, (y - top) / scale, 2.0)), viewer.state.time];""")
    kept, text, pixels, points, time_s = told
    assert kept == [f"{trained.scene.name}_{trained.module.config['name']}_camera.json"]
    (tmp_path / "camera.json").write_text(text)
    scene = replace(trained.scene, notes={**trained.scene.notes, "origin": [5e5, 4e6, 0.0]})
    (frame,) = ListedCameras(tmp_path / "camera.json").in_scene(scene)
    assert frame.time_s == pytest.approx(time_s)
    projected, depths = frame.camera.project(torch.tensor(points, dtype=torch.float64))
    assert projected.numpy() == pytest.approx(np.array(pixels), abs=1e-3) and depths.numpy() == pytest.approx(
        2.0, abs=1e-6
    )
    image = trained.render(frame.camera, frame.time_s, unseen="keep")
    assert image.shape == (frame.camera.height, frame.camera.width)


def test_colours_are_those_of_both_sides_of_another_time(page):
    page.execute_script("viewer.goTo(0); viewer.choose({other: 'nothing'}); viewer.setTime(viewer.told.record[1])")
    page.execute_script("viewer.frame(performance.now()); document.getElementById('auto').click()")
    before = page.execute_script("return viewer.range")
    page.execute_script("viewer.choose({otherTime: viewer.told.record[0], other: 'time', how: 'swipe'})")
    low, high = page.execute_script("return viewer.range")
    assert high > before[1] + 1  # it was warmer at the beginning
    page.execute_script("viewer.state.ranges.values = [10, 11]; viewer.byHand = true; viewer.choose({other: 'truth'})")
    assert page.execute_script("return viewer.range") == [10, 11]  # what was typed in stays


def test_away_from_a_camera_its_image_gives_way_to_the_scene(page):
    page.execute_script("viewer.goTo(0, true); viewer.choose({other: 'recorded', how: 'difference'})")
    assert page.execute_script("return viewer.differing")
    told = "return document.getElementById('message').textContent"
    assert "N and P" in page.execute_script(f"viewer.turn(0.05, 0); {told}")
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    assert not page.execute_script("return viewer.differing") and pixels(page).std(axis=0).max() > 20
    keys(page, "n")
    assert page.execute_script("viewer.say(''); return viewer.differing && viewer.beside") == "recorded"
    assert "N and P" in page.execute_script(f"viewer.stepTime(1); {told}")  # at another time as at another place
    assert page.execute_script("return [viewer.differing, viewer.beside]") == [False, "nothing"]
    keys(page, "n")
    assert page.execute_script("return viewer.differing && viewer.beside") == "recorded"


def test_ends_of_colours_that_make_no_sense_are_refused_and_those_that_hold_shown_again(new_page):
    field = new_page.find_element("id", "low")
    before, shown = new_page.execute_script("""viewer.fitted = true;
      viewer.say = (text) => { viewer.said = text; };
      const one = viewer.splats.attributes.find(({name}) => name === 'time_constant_s');
      Object.assign(one, {log: true, low: 2, high: 4});  // as of times that span more than two powers of ten
      viewer.choose({quantity: 'learned time_constant_s', other: 'nothing'});
      viewer.frame(performance.now());
      return [viewer.range, $('low').value];""")
    for typed, why in (("0", "above 0"), ("-5", "above 0"), ("", ""), ("1e12", "below the upper one")):
        new_page.execute_script("viewer.said = ''")
        field.send_keys(*ALL, typed or "\ue017", "\ue007")  # nothing, by Delete; Enter
        wait_until(new_page, f"!viewer.pending && $('low').value === '{shown}'", 5)
        assert new_page.execute_script("return viewer.range") == before, typed
        assert why in new_page.execute_script("return viewer.said"), typed
    field.send_keys(*ALL, "10", "\ue007")
    assert new_page.execute_script("return viewer.range") == pytest.approx([1, before[1]], abs=1e-3)


def test_what_turns_about_a_point_pins_no_probe(page):
    """Double clicks, and two fingers at once."""
    names = "return viewer.probes.list.map((one) => one.name)"
    before = page.execute_script(
        f"viewer.probes.list = []; for (let i = 0; i < 8; i++) viewer.probes.pin(...viewer.middle()); {names}"
    )
    target = page.execute_script("return viewer.target")
    canvas = page.find_element("id", "canvas")
    box = canvas.rect  # two clicks of a busy machine may come too late to be one double click: their count is stated
    place = {"x": box["x"] + box["width"] / 2 + 40, "y": box["y"] + box["height"] / 2 + 30, "button": "left"}
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            page.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "clickCount": count, **place})
    assert page.execute_script(names) == before and page.execute_script("return viewer.target") != target
    ActionChains(page).move_to_element(canvas).click().perform()
    assert page.execute_script(names) == [*before[1:], str(int(before[-1]) + 1)]

    def touch(kind, *points):
        held = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": held})

    page.execute_script("viewer.probes.list = []")
    touch("touchStart", (200, 250))
    touch("touchStart", (200, 250), (320, 300))
    touch("touchEnd", (200, 250))
    touch("touchEnd")
    assert page.execute_script(names) == []
    touch("touchStart", (200, 250))
    touch("touchEnd")
    assert len(page.execute_script(names)) == 1


def test_sliders_and_buttons_take_only_the_keys_that_they_use(page):
    page.find_element("id", "time").click()
    ActionChains(page).send_keys(" ").perform()
    assert page.execute_script("return viewer.state.playing")
    play = page.find_element("id", "play")
    ActionChains(page).click(play).perform()  # which, unlike play.click(), does not wait for a dozen frames
    assert not page.execute_script("return viewer.state.playing")
    centre, time_s = page.execute_script("return [viewer.camera.centre, viewer.state.time]")
    ActionChains(page).send_keys("\ue012").perform()  # left
    assert page.execute_script("return viewer.camera.centre") != centre
    centre = page.execute_script("return viewer.camera.centre")
    page.execute_script("$('time').focus()")
    ActionChains(page).send_keys("\ue012").perform()
    assert page.execute_script("return viewer.camera.centre") == centre
    assert page.execute_script("return viewer.state.time") != time_s


def test_what_a_gaussian_has_not_learned_is_left_out_of_maps(page):
    """Values of half of the Gaussians of each pixel's weight and more are taken away: such pixels have none."""
    page.execute_script("viewer.goTo(0); viewer.choose({quantity: 'learned time_constant_s', other: 'nothing'})")
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    page.execute_script("viewer.frame(performance.now())")
    before = np.array(page.execute_script("return viewer.sampled()"))
    found = page.execute_script("""const v = viewer, c = v.camera, one = v.attribute, kept = one.values.slice();
      const pixel = v.splats.weightsAt(c, 0.5 * c.width, 0.5 * c.height), at = () => v.splats.attributeAt(pixel, one);
      const all = at(), told = [];
      one.values[pixel.ids[pixel.weights.indexOf(Math.min(...pixel.weights))]] = 65535;
      told.push(at());
      one.values.fill(65535);
      told.push(Number.isNaN(at()));
      v.stale.values = true; v.frame(performance.now());
      told.push(v.sampled().length);
      one.values.set(kept); v.stale.values = true; v.frame(performance.now());
      return [all, ...told, v.sampled().length];""")
    assert found[1] == pytest.approx(found[0], rel=0.05) and found[2] is True and found[3] == 0
    assert found[4] == len(before) > 1000 and before.min() > -1  # log10 of seconds


def by_another_clock(path: Path, later_s: float) -> tuple[dict, bytes]:
    """The header of a page and its block where another image was the first to be trained on."""
    header, block = parts_of(path)
    content = bytearray(block)
    for layer in header["layers"]:
        place = layer["times"]
        times = np.frombuffer(content, "<f8", place["shape"][0], place["offset"])
        times += later_s
    header["span"], header["record"] = ([time + later_s for time in header[key]] for key in ("span", "record"))
    header["moments"] = [[name, time + later_s] for name, time in header["moments"]]
    for camera in header["cameras"]:
        camera["time"] += later_s
    return header, bytes(content)


def test_a_second_run_of_coarser_images_has_the_blur_of_its_own_pixels(new_page, folder, tmp_path):
    header, block = parts_of(folder / FILE)
    blur, wide = 2.0, 4  # pixels² of a fine image, and how many of its pixels one of a coarse image is wide
    for camera in header["cameras"]:
        camera["width"], camera["height"] = camera["width"] / wide, camera["height"] / wide
        camera["intrinsics"] = [value / wide for value in camera["intrinsics"]]
    header["renderer"] |= {"antialiased": False, "eps2d": blur / wide**2}
    (tmp_path / FILE).write_text(pages.page(header, block), encoding="utf-8")
    new_page.execute_script(f"Object.assign(viewer.told.renderer, {{antialiased: false, eps2d: {blur}}})")
    new_page.find_element("id", "run").send_keys(str(tmp_path / FILE))
    wait_until(new_page, "viewer.run && viewer.run.scene.ready")
    new_page.execute_script("viewer.choose({how: 'difference'}); viewer.frame(performance.now())")
    values = np.array(new_page.execute_script("return viewer.sampled()"))
    assert len(values) > 1000 and np.abs(values).max() < 0.01


def test_a_second_run_is_itself_whatever_its_clock(new_page, folder, tmp_path):
    header, block = by_another_clock(folder / FILE, 431.0)
    (tmp_path / FILE).write_text(pages.page(header, block), encoding="utf-8")
    new_page.find_element("id", "run").send_keys(str(tmp_path / FILE))
    wait_until(new_page, "viewer.run && viewer.run.scene.ready")
    assert new_page.execute_script("return viewer.run.later") == pytest.approx(431.0)
    run_note = "return $('runNote').textContent"
    wait_until(new_page, "$('other').selectedOptions[0].text === 'run: etgs, cooling'")
    assert new_page.execute_script(run_note) == "Second run: etgs, cooling."
    old, none, disagreeing = new_page.execute_script("""const {cameras, moments} = viewer.run.told;
      const apart = moments.map(([name, time], i) => [name, time + i]);
      return [{cameras}, {cameras: []}, {cameras: [], moments: apart}].map((told) => laterIn(viewer.told, told));""")
    assert old == pytest.approx(431.0) and none is None and disagreeing is None  # older pages have cameras alone
    new_page.execute_script("viewer.choose({how: 'difference'}); viewer.frame(performance.now())")
    values = np.array(new_page.execute_script("return viewer.sampled()"))
    assert len(values) > 1000 and np.abs(values).max() < 0.01
    at = (
        "const box = document.getElementById('canvas').getBoundingClientRect();"
        "viewer.hover(box.left + 0.6 * box.width, box.top + 0.5 * box.height);"
    )
    told = "return document.getElementById('readout').textContent"
    assert abs(float(new_page.execute_script(at + told).split()[0])) < 0.01  # a difference, not a temperature
    new_page.execute_script("viewer.choose({how: 'swipe'}); viewer.frame(performance.now())")
    assert float(new_page.execute_script(at + told).split()[0]) > 5
    unknown = header | {"moments": [], "cameras": [one | {"name": f"other {one['name']}"} for one in header["cameras"]]}
    new_page.execute_script("viewer.say = (text) => { viewer.said = text; }")
    (tmp_path / "unknown.html").write_text(pages.page(unknown, block), encoding="utf-8")
    new_page.find_element("id", "run").send_keys(str(tmp_path / "unknown.html"))
    wait_until(new_page, "viewer.run.later === 0 && $('other').selectedOptions[0].text.startsWith('run: etgs, ')")
    assert "Images do not tell" in wait_until(new_page, "viewer.said")
    new_page.execute_script("viewer.frame(performance.now())")
    assert "Images do not tell" in new_page.execute_script(run_note)


def test_a_second_run_has_no_values_that_its_image_cannot_hold_either(browser, folder, tmp_path):
    header, block = parts_of(folder / FILE)
    low, high = header["limits"]
    header["limits"] = [low + 0.4 * (high - low), low + 0.6 * (high - low)]
    (tmp_path / FILE).write_text(pages.page(header, block), encoding="utf-8")
    page = opened(browser, tmp_path / FILE)
    page.find_element("id", "run").send_keys(str(tmp_path / FILE))
    wait_until(page, "viewer.run && viewer.run.scene.ready && viewer.state.other === 'run'")
    page.execute_script("viewer.choose({how: 'difference'}); viewer.frame(performance.now())")
    values = np.array(page.execute_script("return viewer.sampled()"))
    assert len(values) > 1000 and np.abs(values).max() < 0.01
    page.execute_script("viewer.state.ranges[viewer.rangeName] = [-1, 1]")
    assert len(np.unique(pixels(page).round(-1), axis=0)) <= 3  # the middle of the colours, and paper


def test_a_second_run_of_another_day_scene_or_place_says_so(new_page, folder, tmp_path):
    header, block = parts_of(folder / FILE)
    week = 7 * 86400.0

    def elsewhere(camera):
        viewmat = list(camera["viewmat"])
        viewmat[3] += header["size"]
        return camera | {"viewmat": viewmat}

    moved = [elsewhere(camera) for camera in header["cameras"]]
    far = [place + 3 * header["size"] for place in header["centre"]]
    unnamed = [camera | {"name": f"other {camera['name']}"} for camera in header["cameras"]]
    cases = {
        "day": ({"start": 1.7e9 + week}, ["7.0 days later", "counts from its own first"], 0),
        "hour": ({"start": 1.7e9 - 60.0}, [], 60),
        "zone": ({"start": 1.7e9 + week, "utc": False}, [], 0),  # a camera's clock is not UTC: images tell
        "scene": ({"scene": "glass"}, ["Second run: etgs, glass. It is of another scene than this one, cooling."], 0),
        "place": ({"cameras": moved}, ["Cameras of the same names stand elsewhere"], 0),
        "extent": ({"cameras": unnamed, "centre": far}, ["It lies elsewhere"], 0),
    }
    new_page.execute_script("Object.assign(viewer.told, {start: 1.7e9, utc: true})")
    for name, (changes, words, later) in cases.items():
        (tmp_path / f"{name}.html").write_text(
            pages.page({**header, "start": 1.7e9, "utc": True, **changes}, block), encoding="utf-8"
        )
        new_page.execute_script("viewer.run = null")
        new_page.find_element("id", "run").send_keys(str(tmp_path / f"{name}.html"))
        wait_until(new_page, "viewer.run && viewer.run.scene.ready && !viewer.pending")
        told = new_page.execute_script("return [viewer.run.later, $('runNote').textContent]")
        assert told[0] == pytest.approx(later), name
        assert all(word in told[1] for word in words), (name, told[1])
        assert words or told[1].count(".") == 1, (name, told[1])


def test_a_page_without_the_keys_of_newer_ones_opens_alone_and_as_a_second_run(new_page, folder, tmp_path):
    header, block = parts_of(folder / FILE)
    old = {key: value for key, value in header.items() if key not in ("start", "utc", "origin")}
    (tmp_path / FILE).write_text(pages.page(old, block), encoding="utf-8")
    new_page.find_element("id", "run").send_keys(str(tmp_path / FILE))
    wait_until(new_page, "viewer.run && viewer.run.scene.ready")
    assert new_page.execute_script("return [viewer.run.note, viewer.run.later]") == ["Second run: etgs, cooling.", 0]
    opened(new_page, tmp_path / FILE)
    new_page.execute_script("viewer.probes.list = []; viewer.goTo(0); viewer.probes.pin(...viewer.middle())")
    assert new_page.execute_script("return viewer.probes.table()").startswith("time (s),probe ")
    assert new_page.execute_script("return viewer.errors") == []


def drawn(page, key: str, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drags with a tool between two shares of the canvas, from its upper left."""
    canvas = page.find_element("id", "canvas")
    width, height = canvas.size["width"], canvas.size["height"]
    keys(page, key)
    to_start = ActionChains(page).move_to_element_with_offset(
        canvas, int((start[0] - 0.5) * width), int((start[1] - 0.5) * height)
    )
    way = int((end[0] - start[0]) * width), int((end[1] - start[1]) * height)
    to_start.click_and_hold().move_by_offset(*way).release().perform()
    wait_until(page, "!viewer.pending && !viewer.sorter.busy && !viewer.stale.order")
    page.execute_script("viewer.frame(performance.now()); viewer.settle()")


def test_a_box_measures_the_pixels_below_it_as_the_renderer_makes_them(page, trained):
    """Against the image of the renderer, over the same part of it; again at another time and from another camera."""
    scene = trained.scene
    frames = [scene.train.frames[i] for i in evenly_spread(len(scene.train), 36)]
    times = min(scene.train.times_s), max(scene.train.times_s)
    page.execute_script("viewer.probes.list = []; viewer.goTo(1)")
    before = page.execute_script("return [viewer.camera.centre, viewer.probes.list.length]")
    drawn(page, "m", (0.4, 0.35), (0.6, 0.7))
    assert page.execute_script("return [viewer.camera.centre, viewer.probes.list.length]") == before
    assert page.execute_script("return [viewer.areas.tool, viewer.areas.list.length]") == ["point", 1]
    for place, time_s in ((1, times[0]), (1, times[1]), (3, times[1])):
        page.execute_script(f"viewer.goTo({place}); viewer.setTime({time_s}); viewer.frame(performance.now())")
        wait_until(page, "!viewer.sorter.busy && !viewer.stale.order && !viewer.pending")
        page.execute_script("viewer.frame(performance.now()); viewer.settle()")
        area = page.execute_script("return viewer.areas.list[0]")
        image = trained.render(frames[place], time_s, unseen="keep")
        (left, top), (right, bottom) = (
            np.round(np.array(area[end]) * image.shape[1::-1]).astype(int) for end in ("from", "to")
        )
        inside, wide = (image[top - more : bottom + more, left - more : right + more] for more in (0, 2))
        found = area["found"]
        assert found["mean"] == pytest.approx(inside.mean().item(), abs=0.3)
        assert found["deviation"] == pytest.approx(inside.std().item(), abs=0.4)
        assert inside.max() - 0.5 < found["hot"]["value"] < wide.max() + 0.5
        assert wide.min() - 0.5 < found["cold"]["value"] < inside.min() + 0.5
        text = page.execute_script("return $('areas').textContent")
        assert f"{found['mean']:.2f} °C" in text and f"{found['count']:,} pixels" in text
    bounds = page.execute_script("return viewer.areas.bounds(viewer.areas.list[0])")
    assert found["count"] == bounds["width"] * bounds["height"]  # all of it shows a surface
    head, row = page.execute_script("return viewer.areas.table()").strip().split("\n")
    told = dict(zip(head.split(","), row.split(","), strict=True))
    assert float(told["mean (°C)"]) == pytest.approx(found["mean"], abs=1e-3)
    assert (told["name"], told["values"], int(told["pixels"])) == ("box 1", '"temperature"', found["count"])


def test_a_box_on_the_picture_becomes_one_in_the_scene_around_what_it_shows(page, trained, tmp_path):
    """Against the depth of the renderer: its surfaces lie in the box, and the box is little larger; with a column more it is a
    table of regions."""
    frame, origin = trained.scene.train.frames[0], [5000.0, -300.0, 20.0]
    page.execute_script(f"viewer.probes.list = []; viewer.goTo(0); viewer.told.origin = {origin}")
    page.execute_script("""viewer.areas.add({kind: 'box', from: [0.6, 0.7], to: [0.4, 0.5]});
      viewer.areas.add({kind: 'line', from: [0.1, 0.1], to: [0.9, 0.9]}); viewer.frame(performance.now())""")
    head, box, line = page.execute_script("return viewer.areas.table()").strip().split("\n")
    assert head.endswith(",x1,y1,z1,x2,y2,z2") and line.endswith("," * 6)
    path = tmp_path / "boxes.csv"
    path.write_text(f"{head},emissivity\n{box},0.3\n", encoding="utf-8")
    (region,) = read_regions(path)
    camera = frame.camera
    rows, columns = (
        slice(round(0.5 * camera.height), round(0.7 * camera.height)), slice(round(0.4 * camera.width), round(0.6 * camera.width))
    )  # fmt: skip
    depth = trained.depth(frame).double()[..., None]
    places = to_world(rays(camera) * depth, camera.viewmat)[rows, columns].reshape(-1, 3) + torch.tensor(origin)
    assert (region_of([region], places) == 0).double().mean() > 0.95
    ends = torch.stack([places.amin(0), places.amax(0)])
    longest = (region.high - region.low).max()
    assert (region.low < ends[1]).all() and (region.high > ends[0]).all()
    assert ((region.high - region.low) - (ends[1] - ends[0]) < 0.15 * longest).all()
    page.execute_script("viewer.areas.list = [{...viewer.areas.list[0], from: [-9, -9], to: [-8, -8]}]")
    assert page.execute_script("return viewer.areas.corners(viewer.areas.list[0])") == [None] * 6


@pytest.mark.parametrize(
    ("depths", "weights", "found"),
    [
        # Neither fog nor what lies behind moves the surface; faint Gaussians count by their share; of none it is infinite.
        ([1, 2, 4, 4.1, 4.2, 9], [0.05, 0.05, 0.15, 0.3, 0.15, 0.3], 4.1),
        ([1, 3, 8], [0.1, 0.5, 0.4], 3),
        ([2, 3], [0.02, 0.02], 2),
        ([], [], None),
    ],
)
def test_a_surface_lies_where_weights_lie_closest(page, depths, weights, found):
    assert page.execute_script(f"return closestDepth({depths}, {weights})") == found


def test_pixels_without_a_surface_do_not_count_in_a_box(page):
    page.execute_script("viewer.goTo(0); viewer.nearer(-12)")
    keys(page, "m", "\ue007")  # Enter
    page.execute_script("Object.assign(viewer.areas.list[0], {from: [-1, -1], to: [2, 2]})")
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order && !viewer.pending")
    found, all_, seen = page.execute_script("""viewer.frame(performance.now()); viewer.settle();
      const {width, height} = $('canvas'), content = viewer.drawing.read('first', 0, 0, width, height);
      let seen = 0;
      for (let j = 3; j < content.length; j += 4) seen += content[j] > 0.5;
      return [viewer.areas.list[0].found.count, width * height, seen];""")
    assert found == seen and 0 < seen < 0.9 * all_
    page.execute_script(
        "Object.assign(viewer.areas.list[0], {from: [-9, -9], to: [-8, -8]}); viewer.frame(performance.now())"
    )
    assert "nothing there" in page.execute_script("return $('areas').textContent")


def test_a_line_shows_its_profile_and_delete_takes_the_last_thing_away(page):
    page.execute_script("viewer.probes.list = []; viewer.goTo(1); viewer.probes.pin(...viewer.middle())")
    drawn(page, "l", (0.2, 0.3), (0.8, 0.6))
    line = page.execute_script("return viewer.areas.list[0]")
    profile = [point["value"] for point in line["profile"]]
    assert line["name"] == "line 1" and line["found"]["count"] == len(profile) > 100
    assert (line["found"]["cold"]["value"], line["found"]["hot"]["value"]) == (min(profile), max(profile))
    assert [line["profile"][i]["along"] for i in (0, -1)] == [0, 1]
    read = "return viewer.valueOf(viewer.drawing.read('first', arguments[0], arguments[1], 1, 1), 0, arguments[0], arguments[1])"
    for point in line["profile"][:: len(profile) // 5]:
        assert page.execute_script(read, point["x"], point["y"]) == pytest.approx(point["value"], abs=1e-4)
    assert page.execute_script("return document.querySelectorAll('#profile .curve').length") == 1
    marks = page.execute_script("return document.querySelectorAll('#marks .area').length")
    assert marks == 4  # twice the line, both ends
    kept = page.execute_script("""const kept = viewer.picturePage(), ratio = $('canvas').width / $('canvas').clientWidth;
      const {x, y} = viewer.areas.list[0].profile[30], size = 6 * ratio;
      const around = kept.getContext('2d').getImageData(x - size / 2, y - size / 2, size, size);
      return [[...around.data], viewer.areas.list[0].colour];""")
    colour = [int(kept[1][i : i + 2], 16) for i in (1, 3, 5)]
    beside = np.abs(np.array(kept[0]).reshape(-1, 4)[:, :3] - colour).max(axis=1)
    assert beside.min() < 15  # the picture that is saved shows the line, a pixel wide and smoothed
    count = "return [viewer.probes.list.length, viewer.areas.list.length]"
    keys(page, "\ue017")
    assert page.execute_script(count) == [1, 0]
    keys(page, "\ue017")
    assert page.execute_script(count) == [0, 0]


def test_a_tool_can_be_left_and_a_click_draws_nothing(page):
    page.execute_script("viewer.probes.list = []; viewer.say = (text) => { viewer.said = text; }")
    keys(page, "m")
    ActionChains(page).move_to_element(page.find_element("id", "canvas")).click().perform()
    found = "return [viewer.areas.list.length, viewer.probes.list.length, viewer.areas.tool]"
    assert page.execute_script(found) == [0, 0, "box"] and "Drag" in page.execute_script("return viewer.said")
    keys(page, "\ue00c")  # Escape
    assert page.execute_script(found) == [0, 0, "point"]
    keys(page, "l", "l")
    assert page.execute_script(found) == [0, 0, "point"]
    wait_until(page, "!viewer.pending")  # the button shows the tool that holds
    page.execute_script("const tool = document.querySelector('[name=tool][value=line]'); tool.click(); tool.focus()")
    ActionChains(page).send_keys("\ue007").perform()  # Enter, beside the picture
    assert page.execute_script(found) == [1, 0, "point"]


def test_differences_are_counted_from_a_probe_of_choice(page):
    page.execute_script("""viewer.probes.list = []; viewer.goTo(1);
      const [x, y] = viewer.middle();
      viewer.probes.pin(x, y); viewer.probes.pin(0.5 * x, 1.3 * y); viewer.frame(performance.now());
      document.querySelector('#probes button').click(); viewer.frame(performance.now());""")
    first, second = page.execute_script("return viewer.probes.list.map((one) => viewer.probes.valueNow(one))")
    shown = page.execute_script("return [...document.querySelectorAll('#probes li')].map((one) => one.textContent)")
    assert f"Δ {second - first:+.2f}".replace("-", "−") in shown[1] and "Δ✕" in shown[0]
    page.execute_script("document.querySelectorAll('#probes li')[0].querySelectorAll('button')[1].click()")
    page.execute_script("viewer.frame(performance.now())")
    left = page.execute_script("return [viewer.probes.reference, $('probes').textContent.includes('Δ')]")
    assert left == [None, False]


def test_tables_tell_the_clock_and_the_coordinates_of_files_where_they_are_known(page):
    page.execute_script("""viewer.probes.list = []; viewer.goTo(0); viewer.probes.pin(...viewer.middle());
      Object.assign(viewer.told, {start: 1782885600, utc: true, origin: [500000, 4000000, 0]});""")
    head, row, *_ = page.execute_script("return viewer.probes.table()").split("\n")
    told = dict(zip(head.split(","), row.split(","), strict=True))
    x = next(value for name, value in told.items() if name.endswith(" x"))
    start = page.execute_script("return viewer.probes.times[0]")
    clock = np.datetime64(round(1e3 * (1782885600 + start)), "ms").item().isoformat(timespec="milliseconds")
    assert told["clock (UTC)"] == f"{clock}Z"
    assert float(x) == pytest.approx(500000 + page.execute_script("return viewer.probes.list[0].point[0]"), abs=1e-5)


def test_the_legend_says_that_its_ends_hold_all_beyond(page):
    page.execute_script("viewer.state.ranges.values = [20, 30]; viewer.frame(performance.now())")
    assert page.execute_script("return [$('barLow').textContent, $('barHigh').textContent]") == ["≤ 20", "≥ 30"]


def test_the_cursor_reads_what_is_shown_on_each_side(page):
    page.execute_script(
        "viewer.goTo(0); viewer.setTime(viewer.told.record[1]); viewer.choose({otherTime: viewer.told.record[0]})"
    )
    wait_until(page, "!viewer.sorter.busy && !viewer.stale.order")
    found = page.execute_script("""const v = viewer, {width, height} = v.drawing.canvas, told = [];
      const x = width >> 1, y = height >> 1;
      for (const split of [0.9, 0.1]) {
        v.choose({other: 'time', how: 'swipe', split}); v.frame(performance.now());
        told.push(v.valueOf(v.drawing.read('first', x, y, 1, 1), 0, x, y));
      }
      const at = [x + 0.5 - v.view.left, y + 0.5 - v.view.top].map((place) => place / v.view.scale);
      const pixel = v.splats.weightsAt(v.camera, ...at);
      return [...told, ...v.splats.seriesAt(pixel, v.layer, [v.state.time, v.state.otherTime])];""")
    assert found[:2] == pytest.approx(found[2:], abs=0.1) and abs(found[0] - found[1]) > 0.3


def test_narrow_screens_have_everything_too(browser, folder):
    browser.set_window_size(500, 800)
    try:
        opened(browser, folder / FILE)
        assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
        for name in ("canvas", "play", "time", "fold"):
            box = browser.find_element("id", name).rect
            width = browser.execute_script("return innerWidth")
            assert box["width"] > 20 and box["x"] >= 0 and box["x"] + box["width"] <= width + 1, name
        browser.find_element("id", "fold").click()
        panel = browser.find_element("id", "panel")
        assert panel.is_displayed() and browser.find_element("id", "quantity").is_displayed()
    finally:
        browser.set_window_size(*USUAL)


@pytest.mark.parametrize("cameras", ["abc", 2.5, -1])
def test_what_is_no_number_of_cameras_is_refused(cameras):
    with pytest.raises(SceneError, match=f"cameras must be a whole number, 1 or more.*got {cameras}"):
        ViewerPage(cameras)
