"""The page that a run serves while it trains, in a real browser: newer states replace the shown one, what people chose stays."""

from dataclasses import dataclass
from typing import Any

import pytest
from running import TINY, run
from viewer.browser import open_browser, opened, wait_until

from heatsplat.export.snapshot import snapshot
from heatsplat.viewer.live import LiveServer
from heatsplat.viewer.page import page, write_viewer
from heatsplat.viewer.payload import payload

pytest.importorskip("selenium.webdriver", reason="selenium is not installed (pip install -e '.[dev]')")

SETTINGS = (*TINY, "method=etgs", "thermal.frequencies=2", "doctor=false", "test=false")
CHOSEN = """viewer.choose({map: 'turbo', quantity: 'camera', walk: true}); viewer.goTo(1);
viewer.turn(0.05, 0.02); viewer.theme('light');
viewer.setTime(0.7 * viewer.told.span[1]); viewer.state.ranges.values = [12, 30];
viewer.probes.list = []; viewer.probes.pin(viewer.camera.width / 2, viewer.camera.height / 2); viewer.areas.choose('box');"""
KEPT = """return JSON.stringify([viewer.state, viewer.camera, viewer.target, document.documentElement.dataset.theme,
viewer.areas.tool, viewer.probes.list.map((one) => [one.name, one.px, one.py])])"""
PICTURE = """const v = viewer, gl = v.drawing.gl, c = gl.canvas; v.frame(performance.now());
const found = new Uint8Array(4 * c.width * c.height); gl.bindFramebuffer(gl.FRAMEBUFFER, null);
gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, found); return Array.from(found).join()"""
SETTLED = "viewer.settled && !viewer.pending && !viewer.sorter.busy && !viewer.stale.order"


@dataclass
class States:
    """Two states of training, and what a run tells of them."""

    modules: list[Any]
    server: LiveServer

    def show(self, number: int) -> None:
        module = self.modules[number - 1]
        header, block = payload(module, snapshot(module), 2)
        told = {
            "state": number,
            "step": 30 * number,
            "steps": 1200,
            "seconds": 1.25 * number,
            "scores": "PSNR 27.31 dB at step 30",
        }
        self.server.show(page(header | {"live": told | {"run": self.server.run}}, block), number)


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    folder = tmp_path_factory.mktemp("states")
    return [run(folder / str(steps), *SETTINGS, f"max_steps={steps}")[0] for steps in (8, 60)]


@pytest.fixture
def states(modules):
    states = States(modules, LiveServer("wall", "127.0.0.1", 0))
    yield states
    states.server.close()


@pytest.fixture(scope="module")
def browser():
    browser = open_browser()
    yield browser
    browser.quit()


def shown(browser, states):
    """The page, once it shows a state."""
    browser.get(states.server.url)
    wait_until(browser, "window.live && viewer.settled")
    return browser


def line(page) -> str:
    return page.find_element("id", "live").text


def test_it_opens_by_itself_once_there_is_a_state(browser, states):
    browser.get(states.server.url)
    assert "Waiting for the first state" in browser.page_source
    states.show(1)
    wait_until(browser, "window.live && viewer.settled")
    assert line(browser) == "step 30 of 1,200 · 1.3 s · PSNR 27.31 dB at step 30"


def test_a_newer_state_takes_its_place_and_what_was_chosen_stays(browser, states, modules, tmp_path):
    states.show(1)
    page = shown(browser, states)
    page.execute_script(CHOSEN)
    wait_until(page, SETTLED)
    kept, before = page.execute_script(KEPT), page.execute_script(PICTURE)
    count = page.execute_script("return viewer.splats.count")
    states.show(2)
    wait_until(page, f"live.state === 2 && {SETTLED}")
    assert line(page).startswith("step 60 of 1,200 · 2.5 s")
    assert page.execute_script(KEPT) == kept
    assert page.execute_script("return [viewer.errors.length, viewer.splats.count !== arguments[0]]", count) == [
        0,
        True,
    ]
    after, probe = page.execute_script(PICTURE), page.execute_script("return viewer.probes.list[0].model")
    assert after != before
    assert page.execute_script("return $('cameras').children.length") == 2
    texts = "return ['quantity', 'other', 'map'].map((id) => [...$(id).options].map((one) => one.value).join())"
    offered = page.execute_script(texts)
    # The same state from a file, looked at in the same way, is the same picture.
    told = opened(browser, write_viewer(modules[1], tmp_path / "viewer.html", 2))
    told.execute_script(CHOSEN)
    wait_until(told, SETTLED)
    assert told.execute_script(PICTURE) == after
    assert told.execute_script("return viewer.probes.list[0].model") == probe
    assert told.execute_script(texts) == offered


def test_a_quantity_that_is_gone_gives_way_to_the_temperature(browser, states):
    states.show(1)
    page = shown(browser, states)
    page.execute_script("viewer.state.quantity = 'without air'; viewer.state.other = 'surface'")
    states.show(2)
    wait_until(page, f"live.state === 2 && {SETTLED}")
    assert page.execute_script("return [viewer.state.quantity, viewer.state.other]") == ["camera", "nothing"]


def test_the_end_is_told_with_the_last_state_and_the_page_stays(browser, states):
    states.show(1)
    page = shown(browser, states)
    states.show(2)
    states.server.end("Training has ended", 60.0)
    wait_until(page, f"live.over && live.state === 2 && {SETTLED}")
    assert line(page).startswith("Training has ended · step 60 of 1,200")
    states.server.close()
    page.execute_script("viewer.turn(0.1, 0); live.ask()")
    wait_until(page, SETTLED)
    assert line(page).startswith("Training has ended") and page.execute_script("return viewer.errors") == []
    states.server = LiveServer("wall", "127.0.0.1", 0)  # for the fixture to close


def test_a_run_that_is_gone_is_told_and_another_one_does_not_take_its_place_unasked(browser, states):
    states.show(1)
    page = shown(browser, states)
    port = states.server.port
    states.server.close()
    wait_until(page, "/^no answer/.test(live.line.textContent)")
    states.server = LiveServer("wall", "127.0.0.1", port)
    states.show(2)
    wait_until(page, "/^another run trains/.test(live.line.textContent)")
    assert page.execute_script("return [live.state, live.over]") == [1, True]


def test_what_keeps_a_newer_state_away_is_told(browser, states):
    states.show(1)
    page = shown(browser, states)
    states.server.tell(problem="none can be seen")
    wait_until(page, "/^no newer state/.test(live.line.textContent)")
    assert line(page).startswith("no newer state: none can be seen · step 30 of 1,200")
    assert page.execute_script("return [live.state, live.over]") == [1, False]  # it goes on asking
    states.server.tell(problem="")
    wait_until(page, "/^step 30/.test(live.line.textContent)")
    assert line(page).startswith("step 30 of 1,200")


def test_a_page_that_nobody_sees_asks_for_nothing(browser, states):
    states.show(1)
    page = shown(browser, states)
    page.execute_script("""window.asked = 0; const before = fetch;
    window.fetch = (...all) => { asked += 1; return before(...all); };
    Object.defineProperty(document, 'hidden', { configurable: true, value: true }); live.ask();""")
    wait_until(page, "!live.asking")
    before = page.execute_script("return asked")
    page.execute_script("live.ask()")
    assert page.execute_script("return asked") == before
    page.execute_script("delete document.hidden; document.dispatchEvent(new Event('visibilitychange'))")
    wait_until(page, f"asked > {before}")
