"""Whole runs of RaViGS: both images are scored and drawn, toggles leave their part out, missing colour is refused."""

import json
from dataclasses import replace

import pytest
from running import TINY, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from heatsplat.contracts import SceneError, ViewSet
from heatsplat.io.tables import read_csv

SHORT = (
    *TINY,
    "method=ravigs",
    "max_steps=12",
    "trainer.val_check_interval=6",
    "callbacks.attributes.test_views=1",
    "callbacks.costs.fps_repeats=1",
    "trainer.limit_test_batches=2",
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ravigs")
    pictures = [text for text in SHORT if text != "callbacks.images=null"]
    module, _ = run(folder, *pictures, "callbacks.images.test_views=1")
    return module, folder, json.loads((folder / "metrics.json").read_text())


def test_both_images_are_scored(finished):
    _, folder, found = finished
    assert found["test"]["psnr"] > 5 and found["test"]["rgb_psnr"] > 5 and 0 < found["test"]["rgb_ssim"] <= 1
    assert found["test"]["rgb_lpips"] is not None or "LPIPS" in found["reasons"]["test.rgb_lpips"]
    assert "data range 1" in found["definitions"]["rgb_psnr"]
    rows = read_csv(folder / "test_per_image.csv")
    assert found["test"]["rgb_psnr"] == pytest.approx(sum(row["rgb_psnr"] for row in rows) / len(rows))
    assert [row["step"] for row in read_csv(folder / "curve.csv")] == [6, 12]
    assert read_csv(folder / "curve.csv")[1]["rgb_psnr"] > 5
    assert f"| RGB PSNR (`rgb_psnr`) | {found['test']['rgb_psnr']:.4g} dB |" in (folder / "report.md").read_text()


def test_both_images_and_the_attributes_are_drawn(finished):
    module, folder, _ = finished
    assert sorted(path.name for path in folder.glob("renders/test/*.png")) == [
        "0000_frame_00000.png",
        "0000_frame_00000_rgb.png",
    ]
    assert [path.name for path in folder.glob("renders/attributes/test/*.png")] == ["0000_frame_00000.png"]
    drawn = EventAccumulator(str(folder / "tb"), size_guidance={"images": 0}).Reload().Tags()["images"]
    assert {"attributes/test/0000_frame_00000", "attributes/val/0000_frame_00000", "test/0000_frame_00000_rgb"} <= set(
        drawn
    )
    frame = module.scene.test.frames[0]
    maps = module.attribute_maps(frame)
    assert list(maps) == ["emissivity", "relative_temperature", "reflectance"]
    for image in maps.values():
        seen = image[image.isfinite()]
        assert image.shape == (52, 64) and len(seen) > 2000 and seen.min() > 0 and seen.max() < 1
    # After 12 steps emissivity is still near its start, and warm pixels are those of high temperature.
    assert maps["emissivity"].nanmedian().item() == pytest.approx(0.9, abs=0.02)
    heat = module.predict(frame)[..., 0]
    warm, cold = heat > heat.quantile(0.8), heat < heat.quantile(0.2)
    assert maps["relative_temperature"][warm].nanmean() > maps["relative_temperature"][cold].nanmean() + 0.05


def test_the_effects_are_told(finished):
    effects = finished[2]["effects"]
    assert effects["radiation"]["degrees"] == {"emissivity": 1, "temperature": 1, "reflectance": 0}
    assert effects["thermal_opacity"] == {"on": True, "opacities": 2}


def test_a_run_without_any_part_has_none_of_them(tmp_path):
    off = ("thermal.dual_opacity=false", "thermal.three_parameter=false", "loss=ravigs_reconstruction", "stages=none")
    module, trainer = run(tmp_path, *SHORT, *off, "density=adaptive")
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["test"]["psnr"] > 5 and found["test"]["rgb_psnr"] > 5
    assert not {"radiation", "thermal_opacity"} & set(found["effects"])
    assert module.splats.opacities.shape[0] == 1
    assert sorted(set(module.splats.names) - {"means", "quats", "log_scales", "opacity_logits"}) == [
        "radiance",
        "radiance_rest",
        "sh0",
        "sh_rest",
    ]
    assert [name for name, _ in module.thermal.named_parameters()] == []
    assert not any(group["weight_decay"] for group in trainer.optimizers[0].param_groups)
    assert not (tmp_path / "renders" / "attributes").exists()
    scalars = EventAccumulator(str(tmp_path / "tb")).Reload().Tags()["scalars"]
    terms = {name for name in scalars if name.startswith("loss/")}
    assert terms == {"loss/total", "loss/thermal/l1", "loss/thermal/dssim", "loss/rgb/l1", "loss/rgb/dssim"}


@pytest.mark.parametrize(("kept", "told"), [(0, "16 of the views"), (5, "11 of the views"), (None, "19 of the views")])
def test_views_without_colour_are_refused_before_training(tmp_path, monkeypatch, kept, told):
    """None of the 16 training views has a colour image, or not every one, or none of these and of the 3 test views."""
    from heatsplat.datamodules.synthetic import Synthetic

    loaded = Synthetic.load

    def colourless(views: ViewSet) -> ViewSet:
        return ViewSet(views.frames, lambda i: views[i] if i < (kept or 0) else replace(views[i], rgb=None))

    def without_colour(self):
        scene = loaded(self)
        test = ViewSet(scene.test.frames, lambda i: replace(scene.test[i], rgb=None))
        held_out = {"test": test, "val": test} if kept is None else {}  # as of scenes of files: the same views
        return replace(scene, train=colourless(scene.train), **held_out)

    monkeypatch.setattr(Synthetic, "load", without_colour)
    message = f"Radiative explains rgb images too, but {told} of scene 'glass' have none, frame_.* first. Give each"
    with pytest.raises(SceneError, match=message):
        run(tmp_path, *TINY, "method=ravigs", "max_steps=2")
