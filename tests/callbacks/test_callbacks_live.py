"""A scene that is watched while it trains: states are served one after the other, cost what they may, and change no weight."""

import json
import logging
import re
import socket
import threading
import time
import urllib.request
from types import SimpleNamespace

import pytest
import pytorch_lightning as pl
import torch
from fake_run import FakeModule, fit, trainer, wall
from running import TINY, run

from heatsplat.callbacks import live
from heatsplat.callbacks.live import LiveViewer
from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.export.snapshot import TOLERANCE_C
from heatsplat.viewer.live import LiveServer
from heatsplat.viewer.page import FILE, LIVE, SOURCES

SHORT = (*TINY, "method=etgs", "max_steps=60", "thermal.frequencies=2", "test=false", "doctor=false")
WATCHED = (
    "callbacks=live",
    "callbacks.live.port=0",
    "callbacks.live.every_s=0.01",
    "callbacks.live.share=1",
    "callbacks.live.cameras=2",
)


class Looking(LiveServer):
    """A browser that has the page open all the time."""

    seen: list[tuple[dict, str]]

    def __init__(self, *arguments):
        super().__init__(*arguments)
        Looking.seen = []
        self.looked = threading.Event()
        threading.Thread(target=self.look, daemon=True).start()
        assert self.looked.wait(30)  # a short run on a busy machine may end before

    def look(self):
        try:
            while True:
                status, page = (
                    urllib.request.urlopen(f"http://127.0.0.1:{self.port}/{path}", timeout=10).read().decode("utf-8")
                    for path in ("status", "")
                )
                Looking.seen.append((json.loads(status), page))
                self.looked.set()
                time.sleep(0.02)
        except OSError:  # it was closed
            return


def header_of(page: str) -> dict:
    return json.loads(re.search(r'id="header">(.*?)</script>', page, re.S)[1])


@pytest.fixture(scope="module")
def unwatched(tmp_path_factory):
    return run(tmp_path_factory.mktemp("unwatched"), *SHORT)[0]


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "LiveServer", Looking)
        module, _ = run(tmp_path_factory.mktemp("watched"), *SHORT, *WATCHED)
    return module, list(Looking.seen)


def test_a_run_is_not_watched_unless_told_so():
    assert "live" not in compose(["method=etgs"])["callbacks"]
    assert compose(["method=etgs", "callbacks=live"])["callbacks"]["live"]["port"] == 7007


def test_states_are_served_one_after_the_other_with_what_is_known_of_them(watched):
    _, seen = watched
    pages = {header["live"]["state"]: header for header in (header_of(page) for _, page in seen if "viewer" in page)}
    assert len(pages) >= 3 and list(pages) == sorted(pages)
    steps = [header["live"]["step"] for header in pages.values()]
    assert steps == sorted(steps) and 1 <= steps[0] < 60 and steps[-1] == 60
    last = list(pages.values())[-1]
    assert last["live"]["steps"] == 60 and last["count"] > 0 and len(last["cameras"]) == 2
    assert re.fullmatch(r"PSNR \d+\.\d\d dB, SSIM \d\.\d+, MAE .* °C at step 60", last["live"]["scores"])
    aims = [layer["aim"] for layer in last["layers"] if layer["name"] == "camera"]
    assert aims == pytest.approx([4 * TOLERANCE_C]) and last["layers"][0]["worst"] <= aims[0]
    assert seen[-1][0]["phase"] == "Training has ended" and seen[-1][0]["state"] == last["live"]["state"]


def test_the_weights_are_those_of_a_run_that_nobody_watched_bit_for_bit(watched, unwatched):
    one, other = watched[0].state_dict(), unwatched.state_dict()
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


def test_its_seconds_are_told_and_are_none_of_training(watched, unwatched):
    cost = watched[0].results.cost
    assert cost["watching_seconds"] > 0.1  # several states
    parts = ("train_seconds", "warmup_seconds", "evaluation_seconds", "watching_seconds")
    assert cost["wall_seconds"] == pytest.approx(sum(cost[name] for name in parts), rel=1e-6)
    assert "watching_seconds" not in unwatched.results.cost


def test_a_page_that_is_not_open_costs_nothing(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(live, "snapshot", lambda *_: pytest.fail("nobody looks"))
    with caplog.at_level(logging.INFO, "heatsplat"):
        module, _ = run(tmp_path, *SHORT, *WATCHED)
    assert "watching_seconds" not in module.results.cost
    assert re.search(r"watch it train: http://localhost:\d+$", caplog.text, re.M)


def test_runs_one_after_the_other_take_the_same_port_and_a_taken_one_is_refused_before_training(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        settings = (*SHORT, "callbacks=live", f"callbacks.live.port={port}", "max_steps=2")
        with pytest.raises(SceneError, match=rf"callbacks\.live\.port={port}: .*callbacks\.live\.port=0"):
            run(tmp_path / "refused", *settings)
        assert not (tmp_path / "refused" / "checkpoints").exists()
    for name in ("first", "second"):
        run(tmp_path / name, *settings)


class Breaks(pl.Callback):
    def on_train_batch_end(self, *_):
        raise RuntimeError("broken")


def test_the_port_is_free_after_a_run_that_failed(tmp_path):
    module = still(FakeModule(wall(), tmp_path))
    watching = LiveViewer(port=0)
    with pytest.raises(RuntimeError, match="broken"):
        fit(module, trainer(tmp_path, [watching, Breaks()], steps=4, every=4))
    assert watching._server is None
    assert "live viewer" not in {thread.name for thread in threading.enumerate()}


def still(module, why=""):
    module.thermal.stays_here = why
    return module


def test_of_methods_whose_gaussians_change_there_is_none_and_it_is_said(tmp_path, caplog):
    module, watching = still(FakeModule(wall(), tmp_path), "its Gaussians change with the view"), LiveViewer(port=0)
    with caplog.at_level(logging.INFO, "heatsplat"):
        fit(module, trainer(tmp_path, [watching], steps=2, every=2))
    assert "no live viewer: its Gaussians change with the view" in caplog.text and "watch it train" not in caplog.text


def test_a_state_that_cannot_be_made_is_told_and_training_goes_on(tmp_path, monkeypatch):
    def none(*_):
        raise SceneError("none of the 300 Gaussians can be seen")

    monkeypatch.setattr(live, "snapshot", none)
    monkeypatch.setattr(live, "LiveServer", Looking)
    module = still(FakeModule(wall(), tmp_path))
    fit(module, trainer(tmp_path, [LiveViewer(port=0)], steps=4, every=4))
    assert module.trainer.global_step == 4
    assert (
        Looking.seen[-1][0]["problem"] == "none of the 300 Gaussians can be seen" and Looking.seen[-1][0]["state"] == 0
    )


def test_who_stops_it_by_hand_does_not_wait_for_a_state(tmp_path, monkeypatch):
    made = []

    def none(module, _):
        made.append(module.global_step)
        raise SceneError("no state")

    monkeypatch.setattr(live, "snapshot", none)
    monkeypatch.setattr(live, "LiveServer", Looking)
    module = still(FakeModule(wall(), tmp_path))  # of 8 steps
    fit(module, trainer(tmp_path, [LiveViewer(port=0)], steps=4, every=4))
    assert 4 not in made and Looking.seen[-1][0]["phase"] == "Training was stopped"


def test_states_wait_for_their_seconds_and_their_share(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: clock.now))
    watching = LiveViewer(every_s=10.0, share=0.05)
    watching._began = 100.0
    assert watching._due()  # the first at once
    watching._states, watching._ended, watching._spent, watching._last = 1, 104.0, 4.0, 4.0
    due = []
    for clock.now in (113.0, 115.0, 259.0, 261.0):  # 8 s are 5 % of 160
        due.append(watching._due())
    assert due == [False, False, False, True]
    watching._spent = watching._last = 0.01
    for clock.now, expected in ((113.0, False), (114.5, True)):
        assert watching._due() is expected


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"port": 65536}, "port must be 65535 or less, got 65536"),
        ({"share": 1.5}, "share must be 1 or less"),
        ({"every_s": 0}, "every_s must"),
        ({"coarser": 0}, "coarser must be above 0"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(settings, told):
    with pytest.raises(SceneError, match=f"callbacks.live.{told}"):
        LiveViewer(**settings)


def test_the_page_that_the_run_leaves_is_the_one_from_a_file(tmp_path):
    shown = [setting for setting in SHORT if setting not in ("callbacks.viewer=null", "test=false")]
    run(tmp_path, *shown, "max_steps=2", "callbacks=live", "callbacks.live.port=0")
    page = (tmp_path / FILE).read_text(encoding="utf-8")
    assert "live" not in header_of(page) and (SOURCES / LIVE).read_text(encoding="utf-8") not in page
