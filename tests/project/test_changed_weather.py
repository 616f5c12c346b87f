"""render.py weather=other.csv: what a shot is told of the weather, without training anything."""

from __future__ import annotations

import inspect
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from weathered import HOUR_S, make_scene

from heatsplat import cli
from heatsplat.composition import compose
from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.runs import run
from heatsplat.shots import shot_frames
from heatsplat.training.module import CHECKPOINT_KEY


class Yard(SceneDataModule):
    """The scene of ``weathered`` as a data module."""

    def load(self) -> SceneData:
        return make_scene()


def gale(folder: Path) -> Path:
    """A table on the clock of the yard's frames: 20 m/s from two hours before the first frame to twenty after it."""
    path = folder / "gale.csv"
    path.write_text("time_s,wind_m_s,air_c\n" + "".join(f"{h * HOUR_S},20,{h}\n" for h in range(-2, 21)))
    return path


def shoot(monkeypatch, folder: Path, needs: set[str], *overrides: str):
    """The frames that a render with these overrides asks a model for."""
    seen = []

    def predict_all(frame):
        seen.append(frame)
        return {"thermal": torch.full((8, 8, 1), 0.5)}

    data = Yard()
    heat = SimpleNamespace(needs=frozenset(needs), beyond_record="nothing changes", companions=())
    module = SimpleNamespace(
        thermal=heat,
        predict_all=predict_all,
        modality="thermal",
        supersample=1,
        sensor=SimpleNamespace(parts={}),
        renderer=SimpleNamespace(backend="auto"),
        render=lambda frame: None,
    )
    stored = {CHECKPOINT_KEY: {"config": {"module": {}, "data": {}}}}
    monkeypatch.setattr(run, "load_checkpoint", lambda ckpt: stored)
    monkeypatch.setattr(run, "build_module", lambda config, output_dir: module)
    monkeypatch.setattr(run, "build", lambda settings: data)
    monkeypatch.setattr(run, "restore", lambda module, data, loaded: setattr(module, "scene", data.scene))
    monkeypatch.setattr("heatsplat.cli.prepare_machine", lambda threads: None)
    options = ("ckpt=any.ckpt", "video=false", "png=false", "frames=3", "unseen=keep", *overrides)
    inspect.unwrap(cli.render)(compose(options, "render"), folder)
    return seen, data.scene


def test_a_shot_has_the_weather_of_its_moments(monkeypatch, tmp_path):
    seen, scene = shoot(monkeypatch, tmp_path, {"weather"}, "trajectory=view", "time=[0,3600]")
    assert [frame.time_s for frame in seen] == [0.0, 1800.0, 3600.0]
    assert [frame.environment for frame in seen] == [scene.weather.at(t) for t in (0.0, 1800.0, 3600.0)]


def test_another_table_is_what_model_and_frames_see(monkeypatch, tmp_path):
    seen, scene = shoot(monkeypatch, tmp_path, {"weather"}, "trajectory=test", f"weather={gale(tmp_path)}")
    assert scene.weather.at(0.0).wind_m_s == 20.0 and scene.weather.pressure_hpa is None
    assert [frame.environment.wind_m_s for frame in seen] == [20.0] * len(scene.test)
    assert seen[0].environment.air_c == pytest.approx(seen[0].time_s / HOUR_S)


@pytest.mark.parametrize("images", ["recorded", "[recorded]", "all", "[all]", "clean", "[recorded,clean]"])
def test_one_image_is_named_as_a_list_of_it_is(monkeypatch, tmp_path, images):
    shoot(monkeypatch, tmp_path, {"weather"}, "trajectory=train", f"images={images}")
    assert {path.name for path in tmp_path.iterdir()} == {"tiff", "frames.csv"}  # without a sensor all images are clean


def test_an_image_that_the_model_lacks_is_named(monkeypatch, tmp_path):
    with pytest.raises(SceneError, match="images must be one of all, recorded, got 'rgb'"):
        shoot(monkeypatch, tmp_path, {"weather"}, "trajectory=train", "images=rgb")


def test_intervals_do_not_follow_from_images_of_another_weather(monkeypatch, tmp_path):
    with pytest.raises(SceneError, match="gale.csv: how certain a temperature is"):
        shoot(monkeypatch, tmp_path, {"weather"}, "trajectory=test", f"weather={gale(tmp_path)}", "uncertainty=true")


def test_a_model_without_weather_says_that_it_changes_nothing(monkeypatch, tmp_path):
    with pytest.raises(SceneError, match=r"weather=.*gale.csv changes nothing: SimpleNamespace does not use weather"):
        shoot(monkeypatch, tmp_path, {"time"}, f"weather={gale(tmp_path)}")


def test_a_moment_outside_the_record_is_refused():
    with pytest.raises(SceneError, match="there is no weather for second 1e.06: the record runs from -7200 to 72000 s"):
        shot_frames(make_scene(), "view", 1e6, 0, 1)


def test_without_a_record_frames_keep_what_they_had():
    bare = make_scene()
    scene = SceneData(bare.name, bare.train, bare.val, bare.test, bare.points)
    assert [f.environment for f in shot_frames(scene, "view", 10.0, 0, 2)] == [None, None]


def test_a_data_set_without_weather_refuses_the_choice(monkeypatch):
    stored = {CHECKPOINT_KEY: {"config": {"data": {"root": "x"}, "module": {}}}}
    monkeypatch.setattr(run, "load_checkpoint", lambda ckpt: stored)
    config = compose(["ckpt=any.ckpt", "data.weather=windy"], "evaluate")
    with pytest.raises(
        SceneError, match="data.weather=windy: the data set of this checkpoint has no weather to choose"
    ):
        run.load(config["ckpt"], config["data"])
