"""The steps that make a run's configuration ready, and the Python interface around them."""

import math
import os
import shutil
from dataclasses import replace

import hydra
import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from running import TINY

import heatsplat
from heatsplat.composition import build, run_of
from heatsplat.contracts import SceneError
from heatsplat.io.recorded import OVERRIDES
from heatsplat.io.results import METRICS_FILE
from heatsplat.runs.checks import check_copied, checked
from heatsplat.runs.folder import results_in
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.resume import differences, on_scene, resumed
from heatsplat.runs.run import begin
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.training.checkpoints import load_checkpoint

QUICK = (
    *TINY,
    "method=3dgs",
    "max_steps=8",
    "data.downscale=4",
    "data.frames=9",
    "doctor=false",
    "trainer.limit_test_batches=1",
)
QUICK = (*QUICK, "callbacks.metrics.lpips_net=null", "callbacks.costs.fps_repeats=1", "callbacks.statistics=null")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a finished run, its configuration and its results."""
    folder, config = tmp_path_factory.mktemp("trained"), heatsplat.compose(QUICK)
    return folder, config, heatsplat.train(config, folder)


def test_a_notebook_composes_trains_loads_and_looks_at_temperatures(trained):
    folder, config, results = trained
    assert (folder / METRICS_FILE).exists() and results.test["psnr"] > 5
    assert heatsplat.train(config, folder).test == results.test  # which are there
    scene = heatsplat.load(folder / "checkpoints" / "last.ckpt")
    frame = scene.scene.test.frames[0]
    celsius, bounds = scene.render(frame, unseen="keep"), scene.scene.thermal_range
    assert celsius.shape == (frame.camera.height, frame.camera.width)
    assert bounds.min_c <= celsius.min() and celsius.max() <= bounds.max_c
    assert torch.equal(scene.render(frame.camera, 0.0, "keep"), celsius)  # static splats know no time
    assert torch.equal(scene.render(frame.camera, torch.tensor(5.0), "keep"), celsius)
    with pytest.raises(TypeError, match="camera must be a Camera or a Frame, .* or view.frame, got View"):
        scene.render(scene.scene.test[0])
    for time_s in ("10min", [0.0, 1.0], math.nan):
        with pytest.raises(ValueError, match="time_s must be a number, got"):
            scene.render(frame.camera, time_s)
    assert "train=ViewSet of 7 views" in repr(scene.scene) and len(repr(scene)) < 2000


def test_pictures_of_rendered_images_are_not_called_recorded(trained, monkeypatch):
    scene = heatsplat.load(trained[0] / "checkpoints" / "last.ckpt")
    assert scene.image_names == ("recorded",) and scene.image_titles == {"recorded": "render"}
    monkeypatch.setattr(scene.module, "sensor", torch.nn.Module())
    scene.module.sensor.parts = {"blur": None}
    assert scene.image_names == ("recorded", "clean")
    flawed = {"recorded": "render, with the sensor's flaws", "clean": "render, without the sensor's flaws"}
    assert scene.image_titles == flawed


def test_visible_images_are_no_temperatures(tmp_path):
    colours = ("data.scene=glass", "thermal.modality=rgb", "thermal.channels=3", "density=fixed", "test=false")
    config = heatsplat.compose([*QUICK, *colours])
    heatsplat.train(config, tmp_path)
    scene = heatsplat.load(tmp_path / "checkpoints" / "last.ckpt")
    frame = scene.scene.test.frames[0]
    assert scene.scene.thermal_range is not None
    image = scene.render(frame, unseen="keep")
    assert torch.equal(image, scene.images(frame, ["recorded"])["recorded"]) and image.shape[2] == 3
    masked = scene.render(frame)
    assert torch.equal(masked.isnan().all(2), ~scene.seen(frame))


def test_what_was_seen_is_told_of_the_image_that_is_rendered(trained, monkeypatch):
    """From a camera that was learned far beside the one that is given, and looks elsewhere."""
    scene = heatsplat.load(trained[0] / "checkpoints" / "last.ckpt")
    frame, other = (scene.scene.train.frames[i] for i in (0, len(scene.scene.train) // 2))
    expected = {camera: scene.seen(replace(frame, camera=camera)) for camera in (frame.camera, other.camera)}
    assert not torch.equal(*expected.values())
    monkeypatch.setattr(scene.module.cameras, "of", lambda frame: other.camera)
    assert torch.equal(scene.seen(frame), expected[other.camera])


def test_a_training_camera_at_another_moment_has_the_drift_of_that_moment(trained, monkeypatch):
    scene = heatsplat.load(trained[0] / "checkpoints" / "last.ckpt")
    drift, (first, *_, last) = FrameOffset(), scene.scene.train.frames
    drift.prepare(scene.scene)
    drift.raw_offset.data = torch.linspace(-0.5, 0.5, len(drift.raw_offset))
    clean = scene.images(first, ["recorded"])["recorded"]
    monkeypatch.setattr(scene.module, "sensor", SensorChain({"drift": drift}))
    early, late = drift.offsets()[[0, -1]].tolist()
    bounds = scene.scene.thermal_range
    assert torch.equal(scene.images(first, ["recorded"])["recorded"], (clean + early).clamp(0, 1))
    for frame in (replace(first, time_s=last.time_s), replace(first, time_s=1e6)):
        assert torch.equal(scene.images(frame, ["recorded"])["recorded"], (clean + late).clamp(0, 1))
    assert torch.equal(scene.render(first, last.time_s, "keep"), bounds.to_celsius((clean + late).clamp(0, 1))[..., 0])


def test_a_step_changes_no_configuration_that_it_is_given(trained):
    _, config, _ = trained
    assert config == heatsplat.compose(QUICK) and "scene" not in config


def test_results_of_other_settings_are_not_taken_for_those_of_this_run(trained):
    folder, config, _ = trained
    with pytest.raises(OccupiedError, match=r"other settings \(seed, data.seed\)"):
        heatsplat.train(heatsplat.compose([*QUICK, "seed=7"]), folder)
    with pytest.raises(OccupiedError, match=r"other settings \([^,]+(, [^,]+){4} and \d+ more\): give another folder"):
        heatsplat.train(heatsplat.compose([*QUICK, "method=energy_balance"]), folder)


def test_results_whose_checkpoints_were_removed_are_those_of_what_the_command_line_gave(trained, tmp_path):
    folder, config, results = trained
    shutil.copy(folder / METRICS_FILE, tmp_path)
    with pytest.raises(OccupiedError, match="results without a checkpoint that tells of which settings they are"):
        results_in(tmp_path, config)
    (tmp_path / ".hydra").mkdir()
    (tmp_path / OVERRIDES).write_text(
        "\n".join(f"- {text}" for text in [*config["overrides"], "callbacks.images=null"])
    )
    assert results_in(tmp_path, config).test == results.test
    with pytest.raises(OccupiedError, match=r"other settings \(max_steps, method\)"):
        results_in(tmp_path, heatsplat.compose([*QUICK, "method=etgs", "max_steps=20", "threads=1"]))


def test_results_of_a_run_that_lightning_ended_are_those_of_that_length(trained, tmp_path):
    """Such a run was taken for one of whatever length was asked for."""
    folder, config, results = trained
    further = heatsplat.compose([*config["overrides"], "trainer.max_steps=6"])
    with pytest.raises(OccupiedError, match=r"results of a run with other settings \(trainer.max_steps\)"):
        results_in(folder, further)
    (tmp_path / ".hydra").mkdir()
    shutil.copy(folder / METRICS_FILE, tmp_path)
    (tmp_path / OVERRIDES).write_text("\n".join(f"- {text}" for text in config["overrides"]))
    assert results_in(tmp_path, config).test == results.test
    with pytest.raises(OccupiedError, match=r"other settings \(trainer.max_steps\)"):
        results_in(tmp_path, further)


def test_a_run_goes_on_from_its_latest_step_whenever_its_files_were_copied(trained, tmp_path):
    folder, config, _ = trained
    (tmp_path / "checkpoints").mkdir()
    for age, step in enumerate((6, 2, 4)):
        path = shutil.copy(folder / "checkpoints" / f"step_{step:06d}.ckpt", tmp_path / "checkpoints")
        os.utime(path, (1e9 + age, 1e9 + age))
    (tmp_path / "checkpoints" / "step_000009.ckpt").write_bytes(b"half of a f")
    assert resumed(checked(config), tmp_path)["ckpt"] == str(tmp_path / "checkpoints" / "step_000006.ckpt")


def test_a_run_that_began_at_another_s_checkpoint_goes_on_from_its_own(trained, tmp_path):
    first = trained[0] / "checkpoints" / "last.ckpt"
    config = heatsplat.compose([*QUICK, "max_steps=16", f"ckpt='{first}'", "test=false"])
    heatsplat.train(config, tmp_path)
    own = tmp_path / "checkpoints"
    for name in ("last", "step_000016"):  # as if it had been killed
        (own / f"{name}.ckpt").unlink()
    assert resumed(checked(config), tmp_path)["ckpt"] == str(own / "step_000012.ckpt")
    other = (
        shutil.copytree(trained[0], tmp_path / "other", ignore=shutil.ignore_patterns("step_*"))
        / "checkpoints"
        / "last.ckpt"
    )
    begun = checked(config | {"ckpt": str(other)})
    assert resumed(begun, tmp_path)["ckpt"] == str(other)  # which it did not begin at


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda config: config.update(seed=1),
            r"seed was changed after compose, from 0 to 1, .*compose\(\[..., 'seed=1'\]\)",
        ),
        (lambda config: config.update(max_steps=9), "max_steps was changed after compose"),
        (lambda config: config["thermal"].update(lr_rate=0.1), "'thermal.lr_rate=0.1'"),
        (
            lambda config: config["loss"]["terms"]["photometric"].update(dssim_weight=0.1),
            "loss.terms.photometric.dssim_weight",
        ),
        (lambda config: config["normals"].update(views=3), "normals.views was changed after compose"),
    ],
)
def test_a_setting_that_is_changed_where_nothing_reads_it_is_refused(change, told):
    config = heatsplat.compose(["method=etgs"])
    assert checked(config) == config
    change(config)
    with pytest.raises(SceneError, match=told):
        checked(config)


def test_a_setting_that_is_not_a_number_was_not_changed():
    config = heatsplat.compose(["method=3dgs", "renderer.background=nan"])
    assert checked(config) is config  # the renderer refuses it


@pytest.mark.parametrize(("method", "key", "value"), [("etgs", "cap_max", 9), ("thermogs", "first_steps", 7)])
def test_a_setting_that_others_were_made_of_is_refused_once_it_is_changed(tmp_path, method, key, value):
    config = heatsplat.compose([*TINY, "max_steps=20", f"method={method}"])
    told = rf"{key} was changed after compose, from \d+ to {value}, and would not take effect: .*'{key}={value}'\]\)"
    with pytest.raises(SceneError, match=told):
        heatsplat.train(config | {key: value}, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    read_where_they_are = {"test": False, "name": "mine", "data": config["data"] | {"seed": 3}}
    check_copied(config | read_where_they_are)
    check_copied(heatsplat.compose([f"method={method}", f"{key}={value}"]))


def test_another_program_that_uses_hydra_composes_ours_and_goes_on_with_its_own(tmp_path):
    (tmp_path / "theirs.yaml").write_text("mine: 1\n")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"):
        theirs = hydra.compose("theirs", return_hydra_config=True)
        HydraConfig.instance().set_config(theirs)
        config = heatsplat.compose(["method=etgs"])
        assert config["name"] == "etgs" and checked(config) == config
        assert hydra.compose("theirs").mine == 1 and HydraConfig.get().job.config_name == "theirs"


@pytest.mark.parametrize(("given", "told"), [(["test=true"], True), (["test=false"], False)])
def test_a_run_whose_scores_would_be_in_no_file_is_warned_of(given, told, caplog):
    checked(heatsplat.compose([*TINY, "method=3dgs", "callbacks.report=null", *given]))
    assert ("leaves no metrics.json" in caplog.text) == told


@pytest.mark.parametrize("overrides", ["method=etgs", [1], {"method": "etgs"}])
def test_overrides_that_are_no_list_of_texts_are_refused(overrides):
    with pytest.raises(TypeError, match="compose takes a list of overrides"):
        heatsplat.compose(overrides)
    with pytest.raises(TypeError, match="train takes a configuration, such as heatsplat.compose"):
        heatsplat.train(overrides)


def test_what_is_given_to_the_module_itself_passes():
    config = heatsplat.compose(["method=etgs", "module.seed=3"])
    assert checked(config) == config


@pytest.mark.parametrize("devices", ["2", "'0,1'"])
def test_several_devices_for_one_scene_are_refused(devices):
    with pytest.raises(SceneError, match="one scene trains on one device, .* ask for 2"):
        checked(heatsplat.compose(["method=3dgs", f"trainer.devices={devices}"]))


@pytest.mark.parametrize("devices", ["[0]", "auto"])
def test_one_device_passes(devices):
    config = heatsplat.compose(["method=3dgs", f"trainer.devices={devices}"])
    assert checked(config) == config


def test_a_checkpoint_of_a_gpu_is_looked_at_where_there_is_none(trained, tmp_path):
    folder, _, _ = trained
    stored = load_checkpoint(folder / "checkpoints" / "last.ckpt")
    expected = heatsplat.load(folder / "checkpoints" / "last.ckpt")
    config = stored["heatsplat"]["config"]
    for settings in (config["renderer"], config["module"]["renderer"]):
        settings["backend"] = "gsplat"
    torch.save(stored, tmp_path / "gpu.ckpt")
    scene = heatsplat.load(tmp_path / "gpu.ckpt")
    frame = scene.scene.test.frames[0]
    assert torch.equal(scene.render(frame, unseen="keep"), expected.render(frame, unseen="keep"))


def test_a_checkpoint_is_read_on_the_scales_of_its_run(trained, tmp_path):
    folder, _, _ = trained
    stored = load_checkpoint(folder / "checkpoints" / "last.ckpt")
    own = heatsplat.load(folder / "checkpoints" / "last.ckpt")
    bounds, frame = own.scene.thermal_range, own.scene.test.frames[0]
    assert stored["heatsplat"]["scales"]["range_c"] == [bounds.min_c, bounds.max_c]
    stored["heatsplat"]["scales"] |= {"range_c": [0.0, 100.0], "first": own.scene.test.frames[0].name}
    stored["heatsplat"]["scales"].pop("frames")  # which are on the clock of their run
    torch.save(stored, tmp_path / "other.ckpt")
    other = heatsplat.load(tmp_path / "other.ckpt")
    torch.testing.assert_close(
        other.render(frame, unseen="keep"), 100 * bounds.to_unit(own.render(frame, unseen="keep")), rtol=1e-4, atol=1e-3
    )
    assert other.scene.test.frames[0].time_s == 0.0 and frame.time_s != 0.0


def test_data_that_a_model_does_not_fit_are_named(tmp_path):
    settings = [key for key in QUICK if not key.startswith("method")]
    config = heatsplat.compose([*settings, "method=etgs", "data.scene=cooling", "data.frames=null", "test=false"])
    heatsplat.train(config, tmp_path)
    with pytest.raises(SceneError, match=r"does not fit data.split=block \(.*leave out what differs from training"):
        heatsplat.load(tmp_path / "checkpoints" / "last.ckpt", {"split": "block"})


def test_what_a_run_was_spared_of_its_images_can_be_had(tmp_path):
    settings = [key for key in QUICK if not key.startswith(("method", "data.downscale"))]
    heatsplat.train(
        heatsplat.compose([*settings, "method=direct_3dgs", "data.scene=noisy_sensor", "test=false"]), tmp_path
    )
    small, whole = (
        heatsplat.load(tmp_path / "checkpoints" / "last.ckpt", data)
        for data in (None, {"degrade": "null", "upsample": "null"})
    )
    sizes = [scene.scene.train.frames[0].camera.width for scene in (small, whole)]
    assert sizes[1] == 4 * sizes[0] == whole.scene.test.frames[0].camera.width


def test_clipping_and_a_plateau_are_settings_that_are_learned_by(trained):
    _, config, _ = trained
    clipped = config | {"trainer": config["trainer"] | {"gradient_clip_val": 0.1, "max_time": "1"}}
    assert differences(clipped, config) == ["trainer.gradient_clip_val"]
    stopping = config | {"callbacks": config["callbacks"] | {"plateau": {"min_gain": 0.1}, "viewer": {"_target_": "x"}}}
    assert differences(stopping, config) == ["callbacks.plateau"]


@pytest.mark.parametrize("changed", ["data.downscale=2", "data.scene=cooling"])
def test_a_checkpoint_of_another_scene_or_image_size_is_refused_with_both(trained, changed):
    """Of a folder elsewhere (data.root) only its scene tells."""
    folder, _, _ = trained
    config = went_on(folder, "max_steps=9")
    there = build(heatsplat.compose([*QUICK, changed])["data"]).scene
    with pytest.raises(SceneError, match=r"was trained on static in \d+ x \d+ pixels, and this is (static|cooling) in"):
        on_scene(config, there)


def went_on(folder, *changed):
    """The configuration of a run that goes on from the last checkpoint of the run in a folder."""
    config = heatsplat.compose([*QUICK, f"ckpt={folder}/checkpoints/last.ckpt", *changed])
    return resumed(checked(config), folder / "on")


@pytest.mark.parametrize(
    ("changed", "keys"),
    [
        ("optim.means=1", "optim.means"),
        ("optim.means=1 max_steps=4000", "optim.means"),
        ("loss=squared", "loss.terms.photometric, loss.terms.squared"),
        ("sensor=frame_offset", "sensor.parts.frame_offset"),
        ("density=adaptive", "density._target_, .*"),
        ("data.split=block", "data.split"),
        ("cap_max=700", "cap_max, density.cap_max"),
        ("+trainer.gradient_clip_val=1", "trainer.gradient_clip_val"),
    ],
)
def test_a_checkpoint_goes_on_with_the_settings_that_it_was_trained_with(trained, changed, keys):
    with pytest.raises(SceneError, match=f"last.ckpt was trained with another {keys}: give what it was trained with"):
        went_on(trained[0], *changed.split())


def test_a_checkpoint_goes_on_for_longer_with_all_that_follows_from_the_length(trained):
    """Not steps alone: of 8 steps an update takes 1 view, of 2000 it takes 2."""
    folder, config, _ = trained
    longer = went_on(folder, "max_steps=2000", "doctor=true", "renderer=cpu")
    assert longer["ckpt"] and longer["optim"]["accumulate"] == 2 * config["optim"]["accumulate"]


def test_a_checkpoint_of_the_last_step_or_a_later_one_is_refused_before_a_run_that_trains_nothing(trained):
    for steps in (8, 5):
        with pytest.raises(
            SceneError,
            match=rf"last.ckpt is of step 8 already, and max_steps={steps}: .*more max_steps, or evaluate it",
        ):
            went_on(trained[0], f"max_steps={steps}")
    assert went_on(trained[0], "max_steps=9")["ckpt"]


def test_the_folder_of_a_run_means_its_last_checkpoint(trained, tmp_path):
    folder, _, _ = trained
    last = folder / "checkpoints" / "last.ckpt"
    for place in (folder, folder / "checkpoints", last):
        assert run_of(str(place)) == str(folder.resolve())
        assert heatsplat.load(place).checkpoint["global_step"] == 8
        config = heatsplat.compose([*QUICK, f"ckpt={place}", "max_steps=9"])
        assert resumed(checked(config), tmp_path)["ckpt"] == str(last)
    shutil.copytree(folder, tmp_path / "run", ignore=shutil.ignore_patterns("last.ckpt"))
    with pytest.raises(SceneError, match=rf"no checkpoint at {tmp_path}/run; there are: .*/step_000008.ckpt"):
        heatsplat.load(tmp_path / "run")


def test_settings_that_an_older_heatsplat_did_not_have_are_warned_of_unless_they_are_asked_for(
    trained, tmp_path, caplog
):
    folder, _, _ = trained
    stored = load_checkpoint(folder / "checkpoints" / "last.ckpt")
    for settings in (stored["heatsplat"]["config"], stored["heatsplat"]["config"]["module"]):
        settings["optim"] = {key: value for key, value in settings["optim"].items() if key != "accumulate_from"}
    torch.save(stored, tmp_path / "old.ckpt")
    assert resumed(heatsplat.compose([*QUICK, f"ckpt={tmp_path}/old.ckpt", "max_steps=9"]), tmp_path)["ckpt"]
    assert "old.ckpt is of an older heatsplat without optim.accumulate_from: they count from here on" in caplog.text
    with pytest.raises(SceneError, match="was trained with another optim.accumulate_from"):
        resumed(heatsplat.compose([*QUICK, f"ckpt={tmp_path}/old.ckpt", "optim.accumulate_from=0.2"]), tmp_path)


def test_an_unfinished_run_of_an_older_heatsplat_is_told_with_its_settings_and_what_to_do(trained, tmp_path):
    stored = load_checkpoint(trained[0] / "checkpoints" / "last.ckpt")
    for settings in (stored["heatsplat"]["config"], stored["heatsplat"]["config"]["module"]):
        settings["optim"] = {key: value for key, value in settings["optim"].items() if key != "accumulate_from"}
    (tmp_path / "checkpoints").mkdir()
    torch.save(stored, path := tmp_path / "checkpoints" / "step_8.ckpt")
    config = checked(heatsplat.compose([*QUICK, "max_steps=8"]))
    with pytest.raises(
        OccupiedError, match="an older heatsplat, which did not have optim.accumulate_from: ckpt="
    ) as told:
        resumed(config, tmp_path)
    assert f"ckpt={path} hydra.run.dir={tmp_path} goes on from step 8" in str(told.value)
    shutil.copy(trained[0] / "metrics.json", tmp_path)
    with pytest.raises(
        OccupiedError, match="results of an older heatsplat, which did not have optim.accumulate_from: give another"
    ):
        results_in(tmp_path, config)
    with pytest.raises(OccupiedError, match=r"with other settings \(optim.accumulate_from\)"):  # that was asked for
        resumed(checked(heatsplat.compose([*QUICK, "optim.accumulate_from=0.2"])), tmp_path)


def test_what_changes_nothing_that_is_learned_is_no_difference(trained):
    folder, config, _ = trained
    stored = load_checkpoint(folder / "checkpoints" / "last.ckpt")["heatsplat"]["config"]
    assert differences(config | {"threads": 1, "test": False, "ckpt": "any"}, stored) == []
    assert differences(config | {"optim": config["optim"] | {"means": 1.0}}, stored) == ["optim.means"]


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("max_steps=-1", "max_steps must be a whole number, 1 or more, got -1"),
        ("max_steps=1e4", "max_steps must be a whole number, 1 or more, got 10000.0"),
        ("seed=abc", "seed must be a whole number, 0 or more, got abc"),
        ("threads=abc", "threads must be 1 to .* got abc"),
        ("threads=5000", "threads must be 1 to .*, got 5000"),
        ("optim.means=-1e-3", "optim.means is a learning rate and must be 0 or more, got -0.001"),
        ("thermal.lr_initial=-1", "thermal.lr_initial is a learning rate"),
        ("loss.terms.photometric.dssim_weight=-0.1", "loss.terms.photometric.dssim_weight is a weight in the loss"),
        ("thermal.source_penalty=-1e-3", "thermal.source_penalty is a weight in the loss and must be 0 or more"),
    ],
)
def test_values_out_of_range_are_refused_by_name(override, told):
    with pytest.raises(SceneError, match=told):
        checked(heatsplat.compose(["method=etgs", override]))


def test_kernels_are_not_told_of_threads_that_are_no_number(tmp_path):
    with pytest.raises(SceneError, match=r"threads must be 1 to .* got abc"):
        begin(heatsplat.compose(["method=etgs", "threads=abc"]), tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("density.start", "abc", "density.start must be a whole number, got abc"),
        ("density.stop", None, "density.stop must be a whole number, got null"),
        ("density.every", 2.5, "density.every must be a whole number, got 2.5"),
        ("density.cap_max", math.nan, "density.cap_max must be a whole number, got nan"),
        ("density.multiple", "abc", "density.multiple must be a number or null, got abc"),
        ("density.floor", math.nan, "density.floor must be a number, got nan"),
        ("thermal.lr_rate", None, "thermal.lr_rate must be a number, got null"),
        ("optim.length_power", True, "optim.length_power must be a number, got true"),
        ("init.separate", "abc", "init.separate must be true or false, got abc"),
    ],
)
def test_settings_of_another_kind_than_their_class_declares_are_refused_by_name(key, value, told):
    """As the command line gives them, in the group and in the module, which is built from its own."""
    config, (group, name) = heatsplat.compose(["method=etgs"]), key.split(".")
    for place in (config[group], config["module"][group]):
        assert name in place
        place[name] = value
    with pytest.raises(SceneError, match=told):
        checked(config)


def test_settings_of_bases_functions_and_parts_in_others_are_of_their_kind_too():
    for method, override, told in (
        ("ti3dgs", "density.start=abc", "density.start must be a whole number"),
        ("ti3dgs", "thermal.emission.floor=abc", "thermal.emission.floor must be true or false"),
        ("auto", "effects.parts.reflection.degree=abc", "effects.parts.reflection.degree must be a whole number"),
        ("supirgs", "loss.terms.high_frequency.schedule.start=abc", "high_frequency.schedule.start must be a number"),
    ):
        with pytest.raises(SceneError, match=told):
            checked(heatsplat.compose([f"method={method}", override]))


def test_no_limit_whole_numbers_with_a_point_and_one_for_true_pass():
    config = heatsplat.compose(["method=etgs", "density.cap_max=inf", "density.every=1e2", "init.separate=0"])
    assert checked(config) == config


@pytest.mark.parametrize("method", ["thermogs", "ntr_gaussian"])
def test_a_first_stage_of_two_lengths_is_refused(method):
    """Frozen geometry and a network that is not used yet leave nothing to train."""
    with pytest.raises(
        SceneError, match="thermal.first_steps=18, but .* follow first_steps=9: set first_steps=18 instead"
    ):
        checked(heatsplat.compose([f"method={method}", "thermal.first_steps=18", "max_steps=30"]))
    checked(heatsplat.compose([f"method={method}", "first_steps=18", "max_steps=30"]))
    with pytest.raises(
        SceneError, match="first_steps=30 leaves no step of max_steps=30 .*fewer first_steps, or more max"
    ):
        checked(heatsplat.compose([f"method={method}", "first_steps=30", "max_steps=30"]))


def test_a_file_to_start_from_that_is_not_there_is_told_before_data_are_read(tmp_path):
    given = ["method=auto", "init=pretrained", f"init.path={tmp_path}/a.ply"]
    with pytest.raises(SceneError, match=r"init.path=.*a.ply: there is no such file"):
        checked(heatsplat.compose(given))
    (tmp_path / "a.ply").touch()
    assert checked(heatsplat.compose(given))["init"]["path"].endswith("a.ply")


def test_what_the_machine_lacks_is_told_before_data_are_read(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match="trainer.accelerator=cuda: PyTorch sees no CUDA device"):
        checked(heatsplat.compose(["method=etgs", "trainer.accelerator=cuda"]))
    with pytest.raises((SceneError, ImportError), match="gsplat"):
        checked(heatsplat.compose(["method=etgs", "renderer=gsplat"]))
