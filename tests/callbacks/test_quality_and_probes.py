"""Scores that cannot be had say why; curves survive a resume; probes are seen by the cameras that look at them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_run import RANGE, SECONDS, FakeModule, camera, evaluate, events, fit, loader, trainer, wall
from pytorch_lightning.callbacks import ModelCheckpoint

from heatsplat.callbacks.images import ImagePanels, file_stem, panels
from heatsplat.callbacks.metrics import QualityMetrics
from heatsplat.callbacks.probes import TemperatureCurves, find_probes, recorded, seen_by
from heatsplat.callbacks.progress import Progress
from heatsplat.callbacks.report import Report
from heatsplat.contracts import SceneError, ViewSet, Weather
from heatsplat.io.tables import read_csv
from heatsplat.sensors.frame_offset import FrameOffset


def scored(scene, folder, *callbacks):
    module = FakeModule(scene, folder)
    evaluate(module, trainer(folder, [QualityMetrics(lpips_net=None), *callbacks], logger=False))
    return module.results


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (wall(thermal_range=None), "the scene has no temperature bounds"),
        (wall(channels=3, modality="rgb"), "rgb images are no temperatures"),
        (wall(channels=3), "pseudo-colour"),
    ],
)
def test_temperature_errors_that_cannot_be_had_say_why(tmp_path, scene, reason):
    results = scored(scene, tmp_path)
    assert results.test["psnr"] > 20 and results.test["ssim"] > 0.5
    for name in ("mae_c", "mae_inlier_c", "mae_roi_c", "mae_roi_scene_c"):
        assert results.test[name] is None
    assert reason in results.reasons["test.mae_c"]
    assert results.test["lpips"] is None and results.reasons["test.lpips"] == "not asked for"


@pytest.mark.parametrize(
    ("net", "weights", "message"),
    [
        ("squeeze", None, "callbacks.metrics.lpips_net must be one of alex, vgg, null, got 'squeeze'"),
        ("alex", "no.pth", "lpips_weights=no.pth: .*not at no.pth"),
        ("alex", "text.pth", "lpips_weights=.*text.pth cannot be read as weights"),
        ("vgg", "other.pth", "lpips_weights=.*other.pth: .* not those of the net"),
    ],
)
def test_lpips_that_was_asked_for_and_cannot_be_had_is_said_before_the_first_step(tmp_path, net, weights, message):
    (tmp_path / "text.pth").write_text("hello")
    torch.save({"features.0.weight": torch.zeros(2)}, tmp_path / "other.pth")
    given = weights if weights in (None, "no.pth") else str(tmp_path / weights)
    module, metrics = FakeModule(wall(), tmp_path), QualityMetrics(lpips_net=net, lpips_weights=given)
    with pytest.raises(SceneError, match=message):
        fit(module, trainer(tmp_path, [metrics], steps=4, every=4, logger=False))
    assert not metrics.curve and module.value.item() == pytest.approx(0.9)


def test_without_the_default_file_of_lpips_the_reason_stands_beside_the_other_scores(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    module = FakeModule(wall(), tmp_path)
    evaluate(module, trainer(tmp_path, [QualityMetrics()], logger=False))
    assert module.results.test["psnr"] > 20 and module.results.test["lpips"] is None
    assert "Download https" in module.results.reasons["test.lpips"]


def test_images_without_region_of_interest_are_not_averaged_in(tmp_path):
    scene = wall()

    def decode(i):
        view = scene.test[i]
        return replace(view, thermal=torch.full_like(view.thermal, 0.3)) if i == 1 else view

    mixed = replace(scene, test=ViewSet(scene.test.frames, decode))
    results = scored(mixed, tmp_path)
    rows = read_csv(tmp_path / "test_per_image.csv")
    having = [row["mae_roi_c"] for row in rows if row["mae_roi_c"] is not None]
    assert rows[1]["mae_roi_c"] is None and len(having) == 3
    assert results.test["mae_roi_c"] == pytest.approx(sum(having) / 3)
    assert "mean of the 3 of 4 test images" in results.definitions["mae_roi_c"]


def test_black_images_are_counted_and_said(tmp_path, caplog):
    """By the pixels that count: a hot one under the mask makes no picture, and an image that is masked all over is none."""
    scene = wall()

    def decode(i):
        view = scene.test[i]
        mask = torch.full(view.thermal.shape[:2], i < 3)
        mask[0, 0] = False
        dead = torch.where(mask[..., None], 0.0, 1.0)
        return replace(view, thermal=dead, mask=mask) if i else view

    results = scored(replace(scene, test=ViewSet(scene.test.frames, decode)), tmp_path)
    assert results.data["test_images_of_one_value"] == 2
    assert "2 of 4 test images have one value everywhere" in caplog.text
    assert "test_images_of_one_value" not in scored(scene, tmp_path).data


def test_identical_images_give_a_psnr_that_every_reader_of_the_file_has(tmp_path):
    scene = wall()
    module = FakeModule(scene, tmp_path)

    def decode(i):
        frame = scene.test.frames[i]
        return replace(scene.test[i], thermal=module.predict(frame))

    module.scene = replace(scene, test=ViewSet(scene.test.frames, decode))
    evaluate(module, trainer(tmp_path, [QualityMetrics(lpips_net=None), Report(show=False)], logger=False))
    assert read_csv(tmp_path / "test_per_image.csv")[0]["psnr"] == 100.0
    content = module.results.as_json()
    assert content["test"]["psnr"] == 100.0 and "test.psnr" not in content["reasons"]


def test_the_course_of_scores_survives_a_resume(tmp_path):
    save = ModelCheckpoint(tmp_path, filename="{step}", every_n_train_steps=6, save_top_k=-1)
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [QualityMetrics(), save], steps=12, every=4)
    fit(module, job)
    whole = read_csv(tmp_path / "curve.csv")
    job.validate(module, loader(module.scene.val), verbose=False)  # of the last step again: a step has one row
    assert read_csv(tmp_path / "curve.csv") == whole
    again = FakeModule(wall(), tmp_path / "b")
    fit(again, trainer(tmp_path, [QualityMetrics()], steps=12, every=4), ckpt=tmp_path / "step=6.ckpt")
    resumed = read_csv(tmp_path / "b" / "curve.csv")
    assert [row["step"] for row in resumed] == [row["step"] for row in whole] == [4, 8, 12]
    assert [row["psnr"] for row in resumed] == pytest.approx([row["psnr"] for row in whole], rel=1e-6)


def test_scores_can_be_monitored(tmp_path):
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [QualityMetrics()], steps=4, every=4)
    fit(module, job)
    assert float(job.callback_metrics["val/psnr"]) == pytest.approx(
        read_csv(tmp_path / "curve.csv")[0]["psnr"], rel=1e-5
    )


def test_curves_are_drawn_at_ever_fewer_validations_and_at_the_test(tmp_path, monkeypatch):
    drawn = []
    draw = TemperatureCurves._draw
    monkeypatch.setattr(TemperatureCurves, "_draw", lambda self, *given: (drawn.append(given[1:]), draw(self, *given)))
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [TemperatureCurves(times=3)], steps=18, every=2)
    fit(module, job)
    assert drawn == [(step, "probes") for step in (2, 4, 8, 16)]
    evaluate(module, job)
    assert drawn[4:] == [(18, "test/probes")] and (tmp_path / "renders" / "probes.png").exists()


def test_a_resumed_run_draws_curves_where_the_whole_one_does(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(TemperatureCurves, "_draw", lambda self, module, step, tag: drawn.append(step))
    save = ModelCheckpoint(tmp_path, filename="{step}", every_n_train_steps=7, save_top_k=-1)
    fit(FakeModule(wall(), tmp_path), trainer(tmp_path, [TemperatureCurves(times=3), save], steps=18, every=2))
    assert drawn == [2, 4, 8, 16]
    again = FakeModule(wall(), tmp_path / "b")
    fit(again, trainer(tmp_path, [TemperatureCurves(times=3)], steps=18, every=2), ckpt=tmp_path / "step=7.ckpt")
    assert drawn[4:] == [8, 16]


def test_panels_without_logger_and_bounds(tmp_path):
    scored(wall(thermal_range=None), tmp_path, ImagePanels(test_views=-1), TemperatureCurves(times=4))
    assert len(list((tmp_path / "renders" / "test").glob("*.png"))) == 4
    assert (tmp_path / "renders" / "probes.png").exists()
    none = tmp_path / "none"
    scored(wall(), none, ImagePanels(test_views=0))
    assert not (none / "renders").exists()


def test_views_that_are_rendered_again_give_the_same_panels(tmp_path, monkeypatch):
    def drawn(folder):
        module = FakeModule(wall(), folder)
        evaluate(module, trainer(folder, [ImagePanels(test_views=-1)], logger=False))
        return module.calls, {path.name: path.read_bytes() for path in (folder / "renders" / "test").glob("*.png")}

    calls, at_once = drawn(tmp_path / "kept")
    monkeypatch.setattr("heatsplat.callbacks.images.KEPT", 1)
    more_calls, again = drawn(tmp_path / "again")
    assert len(again) == 4 and again == at_once
    assert (calls, more_calls) == (4, 7)


def test_a_clean_image_is_compared_with_what_it_is_compared_with():
    scene = wall()
    view, image = scene.test[0], scene.test[0].thermal
    shown = [panels(one, "clean", image, scene)[0] for one in (view, replace(view, clean=image))]
    assert [[panel.title for panel in three] for three in shown] == [
        ["recorded", "render", "render − recorded"],
        ["ground truth", "render", "render − ground truth"],
    ]


def test_a_clean_image_has_scores_only_against_a_clean_one():
    """Otherwise errors hold what the camera added, as the title says."""
    scene = wall()
    view, image = scene.test[0], scene.test[0].thermal
    alone, known = (panels(one, "clean", image, scene)[1] for one in (view, replace(view, clean=image)))
    assert "PSNR" not in alone and "MAE" not in alone and "which is in the difference" in alone
    assert "PSNR" in known and "difference" not in known
    assert "PSNR" in panels(view, "thermal", image, scene)[1]


def test_images_of_a_real_camera_are_not_called_the_truth():
    scene = wall(truth=False)
    shown, _ = panels(scene.test[0], "thermal", scene.test[0].thermal, scene)
    assert [panel.title for panel in shown] == ["recorded", "render", "render − recorded"]
    shown, _ = panels(scene.test[0], "thermal", scene.test[0].thermal, wall())
    assert shown[0].title == "ground truth"


@pytest.mark.parametrize(("known", "told"), [(True, "known to be without it"), (False, "the recorded image")])
def test_scores_of_a_clean_image_say_what_it_is_scored_against(tmp_path, known, told):
    scene = wall()
    if known:
        decoded = [replace(view, clean=view.thermal) for view in scene.test]
        scene = replace(scene, test=ViewSet(scene.test.frames, decoded.__getitem__))
    module = FakeModule(scene, tmp_path)
    step = module.test_step
    module.test_step = lambda view, batch_idx: step(view, batch_idx) | {"companions": {"clean": view.thermal}}
    evaluate(module, trainer(tmp_path, [QualityMetrics(lpips_net=None)], logger=False))
    assert module.results.test["clean_mae_c"] == 0.0 and told in module.results.definitions["clean_..."]


def test_names_are_unique():
    scene = wall()
    frames = [*scene.train.frames, *scene.test.frames]
    assert len({file_stem(frame) for frame in frames}) == len(frames)
    assert len(f"{file_stem(replace(frames[0], name='雪' * 84 + '.png'))}_clean.png".encode()) < 255


def test_models_and_scenes_without_time_have_no_curves(tmp_path):
    module = FakeModule(wall(), tmp_path)
    module.thermal.needs = frozenset()
    evaluate(module, trainer(tmp_path, [TemperatureCurves()], logger=False))
    assert not (tmp_path / "renders").exists()
    timeless = FakeModule(wall(), tmp_path)
    frames = [replace(frame, time_s=None) for frame in timeless.scene.train.frames]
    timeless.scene = replace(timeless.scene, train=ViewSet(frames, lambda i: None))
    evaluate(timeless, trainer(tmp_path, [TemperatureCurves()], logger=False))
    assert not (tmp_path / "renders").exists()


def test_projection_by_hand():
    pixels, depths = camera(0.1).project(torch.tensor([[0.5, -1.0, 4.0], [0.0, 0.0, -1.0]]))
    assert pixels[0].tolist() == pytest.approx([28 + 60 * 0.4 / 4, 20 - 60 / 4])
    assert depths.tolist() == [4.0, -1.0]


def test_hidden_points_are_not_seen():
    cloud = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) * torch.tensor([0.4, 0.4, 0.0])
    screen = cloud + torch.tensor([0.0, 0.0, 2.0])  # a screen before the points at x, y > 0
    points = torch.tensor([[0.3, 0.3, 4.0], [-0.3, -0.3, 4.0], [0.0, 0.0, -4.0], [9.0, 0.0, 4.0], [0.2, 0.2, 2.0]])
    assert seen_by(camera(0.0), points, screen).tolist() == [False, True, False, False, True]
    assert seen_by(camera(0.0), points, screen[:0]).tolist() == [True, True, False, False, True]


def test_probes_are_found_without_the_scenes_help():
    scene = wall(truth=False)
    probes = find_probes(scene, 5)
    assert len(probes) == 5
    for probe in probes:
        (column, row), _ = (x[0].tolist() if x.ndim > 1 else x for x in probe.frame.camera.project(probe.point[None]))
        assert (int(row), int(column)) == (probe.row, probe.column)
    places = torch.stack([probe.point for probe in probes])
    assert torch.pdist(places).min() > 0.3
    times, values = recorded(probes[0], scene, "thermal")
    assert times == scene.train.times_s
    column, row = (int(x) for x in scene.train.frames[2].camera.project(probes[0].point[None])[0][0])
    assert values[2] == scene.train[2].thermal[row, column].item()


def test_probes_of_the_scene_carry_their_names():
    scene = wall()
    assert [probe.name for probe in find_probes(scene, 6)] == ["probe 1", "probe 2"]
    named = replace(scene, notes={"probes": ["stove", "window"]})
    assert [probe.name for probe in find_probes(named, 6)] == ["stove", "window"]
    assert [probe.name for probe in find_probes(named, 1)] == ["stove"]


def test_curves_of_cameras_that_were_trained_on_have_the_drift_of_their_moments(tmp_path):
    """A camera's offset is the image's own where an image is trained on, and lies between neighbours elsewhere."""
    scene = wall()
    drift = FrameOffset()
    drift.prepare(scene)
    drift.raw_offset.data = torch.linspace(-1.0, 1.0, len(scene.train))

    class Drifting(FakeModule):
        def predict(self, frame):
            return drift(super().predict(frame), frame).detach()

    evaluate(Drifting(replace(scene, val=scene.train), tmp_path), trainer(tmp_path, [TemperatureCurves(times=6)]))
    first, *_, last = read_csv(tmp_path / "renders" / "probes.csv")
    cold = RANGE.to_celsius(0.1 + drift.offsets().detach())  # of the wall's right half, which stays as it is
    assert (first["probe 2"], last["probe 2"]) == pytest.approx((cold[0].item(), cold[-1].item()), abs=1e-3)


def test_dots_stand_for_the_truth_on_real_scenes(tmp_path):
    module = FakeModule(wall(truth=False), tmp_path)
    evaluate(module, trainer(tmp_path, [TemperatureCurves(times=4)]))
    assert (tmp_path / "renders" / "probes.png").exists()
    columns = list(read_csv(tmp_path / "renders" / "probes.csv")[0])
    assert columns == ["time_s", "beyond_record_s", *(f"probe {i}" for i in range(1, 7))]
    assert "test/probes" in events(tmp_path).Tags()["images"]


def test_the_table_of_probes_has_the_clock_and_places(tmp_path):
    times = torch.tensor([-100.0, 2 * SECONDS], dtype=torch.float64)
    weather = Weather(times, air_c=torch.tensor([5.0, 6.0], dtype=torch.float64), notes={"utc_at_zero_s": 1722965689.0})
    far = {"origin": [599456.5, 5695495.25, 0.0]}  # taken off coordinates of UTM
    evaluate(
        FakeModule(replace(wall(), weather=weather, notes=far), tmp_path),
        trainer(tmp_path, [TemperatureCurves(times=4)], logger=False),
    )
    rows = read_csv(tmp_path / "renders" / "probes.csv")
    assert [row["clock"] for row in rows[:2]] == ["2024-08-06 17:34:49 UTC", "2024-08-06 17:38:09 UTC"]
    places = read_csv(tmp_path / "renders" / "probe_positions.csv")
    expected = [[599456.0, 5695495.25, 4.0], [599457.0, 5695495.45, 4.0]]
    found = [[row[axis] for axis in "xyz"] for row in places]
    assert np.allclose(found, expected, rtol=0, atol=1e-5)
    assert [row["name"] for row in places] == ["probe 1", "probe 2"]
    assert {row["view"] for row in places} <= {frame.name for frame in wall().val.frames}


def test_dollar_signs_of_names_are_no_formulae(tmp_path):
    scene = replace(wall(), name="a$^$b", notes={"probes": ["$^$", "$5 and $6"]})
    evaluate(FakeModule(scene, tmp_path), trainer(tmp_path, [TemperatureCurves(times=2)], logger=False))
    assert (tmp_path / "renders" / "probes.png").exists()


def test_moments_beyond_the_training_record_are_counted_and_shaded(tmp_path, monkeypatch):
    pictures = []

    def keep(figure):
        pictures.append(figure)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr("heatsplat.callbacks.probes.figure_picture", keep)
    whole, within = wall(), SECONDS / 2
    frames = [replace(frame, time_s=min(frame.time_s, within)) for frame in whole.train.frames]
    scene = replace(whole, train=ViewSet(frames, lambda i: replace(whole.train[i], frame=frames[i])))
    evaluate(FakeModule(scene, tmp_path), trainer(tmp_path, [TemperatureCurves(times=5)], logger=False))
    rows = read_csv(tmp_path / "renders" / "probes.csv")
    assert [row["beyond_record_s"] for row in rows] == pytest.approx([max(row["time_s"] - within, 0) for row in rows])
    assert rows[-1]["beyond_record_s"] > 0
    (axes,) = pictures[-1].axes
    assert "beyond the record" in axes.get_title() and len(axes.patches) == 1


def test_progress_says_how_far_it_is(tmp_path, capsys):
    module = FakeModule(wall(), tmp_path)
    fit(module, trainer(tmp_path, [QualityMetrics(lpips_net=None), Progress()], steps=8, every=4))
    said = capsys.readouterr().err
    assert "8/8" in said
    curve = read_csv(tmp_path / "curve.csv")
    for row in curve:
        assert f"step {row['step']:.0f}:  PSNR {row['psnr']:.2f} dB" in said
        after = said[said.index(f"step {row['step']:.0f}:") :].split("\n")[
            1
        ]  # the line is drawn again, with the step reached
        assert f"{row['step']:.0f}/8" in after
    quiet = FakeModule(wall(), tmp_path)
    fit(quiet, trainer(tmp_path, [Progress(enabled=False)], steps=4, every=4))
    assert "/4" not in capsys.readouterr().err
