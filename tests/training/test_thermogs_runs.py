"""Whole runs of ThermoGS: a first stage and frozen geometry, geometry of another run, terms and rows of the ablations."""

from dataclasses import replace

import pytest
import torch
from omegaconf import OmegaConf
from running import NO_PICTURES, compose_run, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from weathered import make_scene

from heatsplat.composition import CONF
from heatsplat.contracts import SceneError
from heatsplat.io.ply import write_splats
from heatsplat.splats import GEOMETRY
from heatsplat.training.init import Pretrained

SHORT = (
    "data.size=tiny",
    "data.downscale=2",
    "threads=1",
    "method=thermogs",
    "max_steps=20",
    "thermal.width=16",
    "callbacks.images=null",
    "callbacks.probes=null",
    "callbacks.viewer=null",
    *NO_PICTURES,
    "callbacks.statistics.every=1",
    "callbacks.attributes.test_views=1",
    "callbacks.costs.fps_repeats=1",
    "trainer.limit_val_batches=1",
    "trainer.limit_test_batches=2",
    "trainer.val_check_interval=10",
)
NETWORK = "thermal.network.own.weight"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("thermogs")
    module, _ = run(folder, *SHORT)
    return module, folder


def stored(folder, name):
    return torch.load(folder / "checkpoints" / f"{name}.ckpt", weights_only=True)["state_dict"]


def test_geometry_settles_first_and_then_stands_still_while_the_network_learns(finished):
    _, folder = finished
    before, first, then, last = (stored(folder, f"step_{step:06d}") for step in (5, 10, 15, 20))
    for name in (*GEOMETRY, "first_value"):  # the first stage ends with step 6
        assert torch.equal(then[f"splats.raw.{name}"], last[f"splats.raw.{name}"]), name
        assert torch.equal(first[f"splats.raw.{name}"], last[f"splats.raw.{name}"]), name
        assert not torch.equal(before[f"splats.raw.{name}"], last[f"splats.raw.{name}"]), name
    assert not torch.equal(before[NETWORK], first[NETWORK]) and not torch.equal(first[NETWORK], last[NETWORK])
    assert not torch.equal(first["splats.raw.feature"], last["splats.raw.feature"])
    assert torch.equal(first["splats.raw.label"], last["splats.raw.label"])
    assert not before["thermal.emits"] and first["thermal.emits"]


def test_all_six_terms_are_logged_and_attributes_drawn(finished):
    module, folder = finished
    scalars = EventAccumulator(str(folder / "tb")).Reload().Tags()["scalars"]
    terms = {name.removeprefix("loss/") for name in scalars if name.startswith("loss/")}
    assert terms == {"total", "data/l1", "data/dssim", "edge", "smooth", "physical", "ode", "pinn"}
    assert list((folder / "renders" / "attributes" / "test").glob("*.png"))
    maps = module.attribute_maps(module.scene.test.frames[0])
    assert set(maps) == {"emissivity", "absorptivity", "convection", "capacity"}
    seen = maps["emissivity"][maps["emissivity"].isfinite()]
    assert len(seen) > 100 and seen.min() > 0.5 and seen.max() < 1
    assert module.results.test["psnr"] > 8 and module.results.effects["solar"]["projected_area"] == "exact"


def test_a_checkpoint_or_a_point_cloud_gives_geometry_that_never_moves(finished, tmp_path):
    module, folder = finished
    splats, name = module.splats, "cloud.ply"
    arrays = {key: splats[key].detach() for key in GEOMETRY}
    write_splats(tmp_path / name, **arrays, values=splats["first_value"].detach()[:, None])
    for number, path in enumerate((folder / "checkpoints" / "last.ckpt", tmp_path / name)):
        given = ("init=pretrained", f"init.path={path}", "max_steps=3", "test=false")
        again, _ = run(tmp_path / str(number), *SHORT, *given)
        for key in GEOMETRY:
            assert torch.equal(again.splats[key].detach(), splats[key].detach()), key
        assert again.thermal.first_steps == 0
        assert again.thermal.network.heads["temperature"].weight.abs().sum() > 0  # which start at zero


def test_a_trained_network_serves_another_scene_without_learning(finished, tmp_path):
    module, folder = finished
    given = (f"thermal.network={folder}/checkpoints/last.ckpt", "max_steps=8", "data.scene_seed=1")
    other, _ = run(tmp_path, *SHORT, *given)
    for name, weights in other.thermal.network.state_dict().items():
        assert torch.equal(weights, module.thermal.network.state_dict()[name]), name
    assert not torch.equal(other.splats["means"][:50], module.splats["means"][:50])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("lost.ply", None, "there is no such file"),
        ("bad.ply", b"no points", "not a PLY"),
        ("bad.ckpt", b"nothing", "not a checkpoint that can be read"),
    ],
)
def test_files_without_splats_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=message):
        Pretrained(str(tmp_path / name))(make_scene(), None, 0)


def test_a_scene_without_weather_is_refused_before_training(tmp_path, monkeypatch):
    from heatsplat.datamodules.synthetic import Synthetic

    loaded = Synthetic.load
    monkeypatch.setattr(Synthetic, "load", lambda self: replace(loaded(self), weather=None))
    with pytest.raises(SceneError, match="lacks 'weather'.*give the data set a weather record"):
        run(tmp_path, *SHORT, "test=false")


def test_the_ablations_have_the_rows_of_the_tables():
    rows = OmegaConf.load(f"{CONF}/ablation/thermogs_losses.yaml").hydra.sweeper.rows
    whole = {"data": 0.8, "edge": 0.2, "smooth": 1.0, "physical": 0.01, "ode": 0.01, "pinn": 1.0}
    left_out = []
    for row in rows.values():
        config = OmegaConf.to_container(compose_run(*SHORT, *row["set"]), resolve=True)
        weights = config["thermal"]["weights"] | {name: t["weight"] for name, t in config["loss"]["terms"].items()}
        off = [name for name in whole if weights[name] == 0]
        assert weights == whole | dict.fromkeys(off, 0)
        left_out.append(off)
    assert left_out == [["edge"], ["smooth"], ["physical"], ["ode"], ["pinn"], []]
    rows = OmegaConf.load(f"{CONF}/ablation/thermogs_attributes.yaml").hydra.sweeper.rows
    chosen = [compose_run(*SHORT, *row["set"]).thermal.attributes for row in rows.values()]
    assert chosen == ["table", "inferred"]
