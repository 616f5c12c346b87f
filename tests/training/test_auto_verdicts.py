"""method=auto from images to the table of effects, with the verdicts that the images themselves lead to."""

import pytest
from running import TINY, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from heatsplat.callbacks.report_words import EFFECT_WORDS
from heatsplat.effects import assembly
from heatsplat.io.results import RunResults

SHORT = (*TINY, "max_steps=20", "density=fixed", "trainer.val_check_interval=20", "trainer.limit_test_batches=1")


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A run on a scene that stays as it is before a sensor that drifts."""
    folder = tmp_path_factory.mktemp("drifting")
    module, _ = run(folder, *SHORT, "method=auto", "data.scene=drifting")
    return folder, module, RunResults.read(folder / "metrics.json")


def test_what_the_images_show_is_simulated_and_nothing_else(drifting):
    _, module, results = drifting
    truth = set(results.data["effects"])
    assert truth == {"frame_offset"}
    assert list(results.effects) == list(assembly.NAMES)
    assert {name for name, effect in results.effects.items() if effect["on"]} == truth
    assert set(module.thermal.effects()) | set(module.sensor.effects()) == truth
    assert [name for name, _ in module.sensor.named_parameters()] == ["parts.frame_offset.raw_offset"]
    assert not list(module.thermal.parameters())


def test_every_effect_has_its_figures_and_what_is_on_its_price(drifting):
    _, module, results = drifting
    for name, effect in results.effects.items():
        assert {"on", "statistic", "threshold", "reason", "parameters", "ms_per_step"} <= effect.keys()
        assert len(effect["reason"]) > 10
        measured = effect["statistic"] is not None
        assert (effect["threshold"] is not None) == measured
        assert not measured or (effect["statistic"] > effect["threshold"]) == effect["on"], name
        if not effect["on"]:
            assert effect["parameters"] == 0 and effect["ms_per_step"] == 0.0
    drift = results.effects["frame_offset"]
    assert drift["told"] and drift["gain_db"] > 3
    assert drift["statistic"] > 10 * drift["threshold"]
    assert drift["parameters"] == drift["settings"]["frames"] == len(module.scene.train)
    assert isinstance(drift["ms_per_step"], float)
    for name in ("solar", "radiation", "convection"):  # nobody recorded any
        assert results.effects[name]["statistic"] is None and "weather" in results.effects[name]["reason"]


def test_the_table_is_in_tensorboard_from_the_start_and_in_the_report(drifting):
    folder, _, results = drifting
    events = EventAccumulator(str(folder / "tb")).Reload()
    tags = [tag for tag in events.Tags()["tensors"] if tag.split("/")[0] == "effects"]
    (told,) = events.Tensors(tags[0])
    assert len(tags) == 1 and told.step == 0
    table = told.tensor_proto.string_val[0].decode()
    report = (folder / "report.md").read_text()
    (weather,) = (line for line in table.splitlines() if line.endswith(": no; the scene lacks weather, which it needs"))
    assert weather in report
    together = weather.removeprefix("- ").partition(":")[0].split(", ")
    labels = {name: f"{EFFECT_WORDS[name]} (`{name}`)" for name in results.effects}
    assert {labels[name] for name in ("solar", "radiation", "convection")} <= set(together)
    for name, effect in results.effects.items():
        row = f"| {labels[name]} | {'**yes**' if effect['on'] else 'no' if effect['told'] else 'cannot be told'} |"
        assert labels[name] in together or (row in table and row in report)
        assert effect["reason"].replace("|", "/") in table
