"""A short run with all callbacks: what it leaves behind, compared with what can be computed without them."""

import csv
import json
import re

import cv2
import numpy as np
import pytest
import torch
from fake_run import HEIGHT, RANGE, SECONDS, WIDTH, FakeModule, evaluate, events, fit, trainer, wall, warmth
from skimage.metrics import peak_signal_noise_ratio

from heatsplat.callbacks.images import ImagePanels
from heatsplat.callbacks.metrics import QualityMetrics
from heatsplat.callbacks.probes import TemperatureCurves
from heatsplat.callbacks.progress import Progress
from heatsplat.callbacks.report import Report, pictures_of
from heatsplat.callbacks.statistics import SplatStatistics
from heatsplat.callbacks.timing import CostMeter
from heatsplat.contracts import Camera, Frame
from heatsplat.io.results import RunResults
from heatsplat.io.tables import read_csv
from heatsplat.metrics.definitions import COSTS, DEFINITIONS

CONFIG = {
    "name": "etgs",
    "seed": 3,
    "thermal": {"_target_": "heatsplat.thermal.newton_harmonic.NewtonHarmonic", "frequencies": 24, "grid": [1, 2]},
    "trainer": {"accelerator": "cpu"},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    before = torch.hub.get_dir()
    torch.hub.set_dir(str(folder / "hub"))  # no weights of LPIPS here, whatever this machine holds
    module = FakeModule(wall(), folder, CONFIG)
    watchers = [
        CostMeter(every=4, fps_views=2, fps_repeats=3),
        SplatStatistics(every=4, histogram_every=8),
        QualityMetrics(),
    ]
    watchers += [ImagePanels(val_views=2, test_views=3), TemperatureCurves(times=9), Progress(), Report(pictures=2)]
    job = trainer(folder, watchers, steps=24, every=8)
    fit(module, job)
    evaluate(module, job)
    torch.hub.set_dir(before)
    return module, folder, job


def images(module, views):
    """Prediction and ground truth of views, with the pixels that count."""
    return [(module.predict(v.frame).double().numpy(), v.thermal.double().numpy(), v.mask.numpy()) for v in views]


def test_scores_are_means_of_images(run):
    module, folder, _ = run
    test = RunResults.read(folder / "metrics.json").test
    pairs = images(module, module.scene.test)
    psnr = [peak_signal_noise_ratio(t[m], p[m], data_range=1.0) for p, t, m in pairs]
    mae = [40 * np.abs(t[m] - p[m]).mean() for p, t, m in pairs]
    warm = [40 * np.abs(t - p)[m & (t[..., 0] > 0.15)].mean() for p, t, m in pairs]
    assert test["psnr"] == pytest.approx(np.mean(psnr), abs=1e-6)
    assert test["mae_c"] == pytest.approx(np.mean(mae), rel=1e-6)
    assert test["mae_roi_c"] == pytest.approx(np.mean(warm), rel=1e-6)
    assert test["mae_roi_scene_c"] == pytest.approx(np.mean(warm), rel=1e-6)
    with open(folder / "test_per_image.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [frame.name for frame in module.scene.test.frames]
    assert [float(row["psnr"]) for row in rows] == pytest.approx(psnr, abs=1e-6)
    assert {row["lpips"] for row in rows} == {""}
    assert float(rows[0]["counted"]) == pytest.approx(1 - 9 / (HEIGHT * WIDTH))


def test_every_number_is_there_or_explained(run):
    content = json.loads((run[1] / "metrics.json").read_text())
    assert set(DEFINITIONS) <= set(content["test"]) and set(COSTS) <= set(content["cost"])
    for section in ("test", "cost"):
        for name, value in content[section].items():
            assert (value is None) == (f"{section}.{name}" in content["reasons"]), name
    assert "https://download.pytorch.org/models/alexnet" in content["reasons"]["test.lpips"]
    assert content["run"]["method"] == "etgs" and content["run"]["steps"] == 24
    assert "cores" in content["run"]["machine"] and content["run"]["threads"] == torch.get_num_threads()
    assert content["effects"] == {"newton_cooling": {"on": True, "ambient": "learned"}}
    assert content["data"]["timestamps"] == "from file names"
    assert content["data"]["views"] == {"train": 6, "val": 3, "test": 4}
    assert content["data"]["thermal_range_c"] == [10.0, 50.0]
    assert 10 < content["definitions"]["scene_threshold_c"] < 21
    assert content["versions"]["torch"] == torch.__version__


def test_costs_add_up(run):
    cost = RunResults.read(run[1] / "metrics.json").cost
    assert cost["steps_per_second"] == pytest.approx((24 - 3) / cost["train_seconds"], rel=1e-6)
    parts = cost["train_seconds"] + cost["warmup_seconds"] + cost["evaluation_seconds"]
    assert cost["wall_seconds"] == pytest.approx(parts, rel=1e-6)
    assert cost["gaussians"] == 300
    assert cost["peak_memory_mb"] > 100
    assert cost["render_fps"] > 100


def test_course_over_steps_and_seconds(run):
    module, folder, _ = run
    rows = read_csv(folder / "curve.csv")
    assert list(rows[0]) == ["step", "train_seconds", "cpu_seconds", "gaussians", "loss", *DEFINITIONS]
    assert [row["step"] for row in rows] == [8, 16, 24]
    seconds = [row["train_seconds"] for row in rows]
    assert 0 < seconds[0] < seconds[1] < seconds[2] <= module.results.cost["train_seconds"]
    assert rows[0]["psnr"] < rows[2]["psnr"] and rows[0]["mae_c"] > rows[2]["mae_c"]
    pairs = images(module, module.scene.val)
    expected = [peak_signal_noise_ratio(t[m], p[m], data_range=1.0) for p, t, m in pairs]
    assert rows[2]["psnr"] == pytest.approx(np.mean(expected), abs=1e-6)
    assert (folder / "renders" / "curves.png").exists()


def test_tensorboard(run):
    module, folder, _ = run
    found = events(folder)
    scalars = set(found.Tags()["scalars"])
    terms = {"loss/total", "loss/data", "loss/prior", "learning_rate/value", "learning_rate/means", "density/count"}
    assert terms | {"cost/train_seconds", "cost/peak_memory_mb"} <= scalars
    for name in ("psnr", "ssim", "mae_c", "mae_roi_c"):
        assert {f"val/{name}", f"val_by_seconds/{name}", f"test/{name}", f"final/{name}"} <= scalars
    curve = read_csv(folder / "curve.csv")
    assert [event.step for event in found.Scalars("val/psnr")] == [8, 16, 24]
    assert [event.value for event in found.Scalars("val/psnr")] == pytest.approx(
        [row["psnr"] for row in curve], rel=1e-5
    )
    by_seconds = found.Scalars("val_by_seconds/mae_c")
    assert [event.step for event in by_seconds] == [round(row["train_seconds"]) for row in curve]
    assert [event.value for event in by_seconds] == pytest.approx([row["mae_c"] for row in curve], rel=1e-5)
    losses = {event.step: event.value for event in found.Scalars("loss/total")}
    assert list(losses) == [1, 4, 8, 12, 16, 20, 24]
    parts = [found.Scalars(f"loss/{name}")[-1].value for name in ("data", "prior")]
    assert losses[24] == pytest.approx(sum(parts), rel=1e-5)
    assert "splats/opacity_0" in found.Tags()["histograms"]
    assert {"val/0006_000", "val/0008_002", "probes", "test/probes", "test/0009_000"} <= set(found.Tags()["images"])
    summaries = found.SummaryMetadata
    assert summaries("_hparams_/session_start_info").plugin_data.plugin_name == "hparams"


def test_report_is_whole(run):
    _, folder, _ = run
    text = (folder / "report.md").read_text()
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(pictures) == 4  # curves, two test views, probes
    for path in [*pictures, *re.findall(r"[^!]\[[^\]]*\]\(([^)]+)\)", text)]:
        assert (folder / path).is_file(), path
    test = RunResults.read(folder / "metrics.json").test
    assert f"| PSNR (`psnr`) | {test['psnr']:.4g} dB |" in text
    assert "| LPIPS (`lpips`) | – |" in text and "`test.lpips`: LPIPS(alex) needs" in text
    assert "timestamps: from file names" in text
    assert "newton cooling (`newton_cooling`): temperature of the surroundings learned" in text
    assert text.startswith("# etgs on wall")


def test_pictures_show_what_they_say(run):
    _, folder, _ = run
    drawn = sorted(p.relative_to(folder).as_posix() for p in folder.glob("renders/*/*.png"))
    assert drawn == [
        "renders/test/0009_000.png",
        "renders/test/0011_002.png",
        "renders/test/0012_003.png",
        "renders/val/0006_000.png",
        "renders/val/0008_002.png",
    ]
    for path in drawn:
        picture = cv2.imread(str(folder / path))
        assert picture.shape[1] > 3 * picture.shape[0] > 600
        event = events(folder).Images(path.removeprefix("renders/").removesuffix(".png"))[-1]
        assert event.encoded_image_string == (folder / path).read_bytes() and event.step == 24
        assert (event.height, event.width) == picture.shape[:2]


def test_a_view_s_companions_come_after_it_and_take_no_other_view_s_place(tmp_path):
    camera = Camera(torch.eye(4), torch.eye(3), 8, 6)
    frames = [Frame(f"a[{i}].png", i, camera) for i in range(4)]
    for i in (0, 1, 3):  # of frame 2 nothing was drawn
        for ending in ("", "_clean"):
            (tmp_path / f"{i:04d}_a[{i}]{ending}.png").touch()
    assert [path.name for path in pictures_of(tmp_path, frames, 2)] == [
        "0000_a[0].png", "0000_a[0]_clean.png", "0003_a[3].png", "0003_a[3]_clean.png",
    ]  # fmt: skip
    assert pictures_of(tmp_path, frames, 0) == []


def test_curves_at_probes(run):
    module, folder, _ = run
    rows = read_csv(folder / "renders" / "probes.csv")
    times = np.array([row["time_s"] for row in rows])
    assert times == pytest.approx(np.linspace(0, SECONDS, 9))
    truth = RANGE.to_celsius(warmth(torch.from_numpy(times)).numpy())
    assert [row["truth of probe 1"] for row in rows] == pytest.approx(truth)
    model = 10 + 40 * module.value.item() * warmth(torch.from_numpy(times)).numpy()  # probe 1 lies on the warm half
    assert [row["probe 1"] for row in rows] == pytest.approx(model, rel=1e-5)
    assert [row["probe 2"] for row in rows] == pytest.approx([14.0] * 9, rel=1e-5)
