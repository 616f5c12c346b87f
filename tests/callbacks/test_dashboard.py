"""The layout of TensorBoard: every panel finds a curve that training really writes."""

import csv
import re
from itertools import chain

from fake_run import FakeModule, events, fit, trainer, wall
from pytorch_lightning.loggers import CSVLogger
from running import TINY, run

from heatsplat.callbacks.dashboard import LAYOUT, Dashboard
from heatsplat.composition import compose
from heatsplat.runs.run import begin, build_loggers
from heatsplat.training.session import fit as training_fit


def test_the_layout_is_written_once_per_run(tmp_path):
    fit(FakeModule(wall(), tmp_path), trainer(tmp_path, [Dashboard()], steps=2, every=2))
    tags = events(tmp_path).Tags()["tensors"]
    assert tags.count("custom_scalars__config__") == 1


def test_runs_with_other_loggers_write_their_numbers(tmp_path):
    table, both = tmp_path / "table", tmp_path / "both"
    quick = (*TINY, "method=3dgs", "data.downscale=4", "max_steps=4", "callbacks.statistics.every=2")
    run(table, *quick, "logger=csv")
    with (table / "logs" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    steps = {int(row["step"]): row for row in rows if row["loss/total"]}
    assert sorted(steps) == [1, 2, 4] and float(steps[4]["density/count"]) > 0
    assert any(row["val/psnr"] for row in rows) and any(row["final/psnr"] for row in rows)

    config = compose([*quick, "logger=csv", "test=false"])
    config["logger"] = {"board": compose(["logger=tensorboard"])["logger"], "table": config["logger"], "off": None}
    begun = begin(config, both)
    training_fit(begun.module, begun.data, begun.trainer, test=False)
    assert (both / "logs" / "metrics.csv").exists() and "loss/total" in events(both).Tags()["scalars"]


class Elsewhere(CSVLogger):
    """A logger that knows by itself where it writes."""

    def __init__(self, prefix: str = "") -> None:
        super().__init__("elsewhere", prefix=prefix)


class Board(CSVLogger):
    """A logger that hands on what it is given."""

    def __init__(self, **settings) -> None:
        super().__init__(**settings)


def test_a_logger_need_not_take_a_folder(tmp_path):
    own, handed_on = ({"_target_": f"{__name__}.{kind.__name__}", "prefix": "a"} for kind in (Elsewhere, Board))
    found = build_loggers({"own": own, "handed on": handed_on}, tmp_path)
    assert [one.save_dir for one in found] == ["elsewhere", str(tmp_path)]


def test_every_panel_finds_curves_of_a_real_run(tmp_path):
    often = (
        "trainer.val_check_interval=6",
        "callbacks.statistics.every=3",
        "callbacks.costs.every=3",
        "density.start=2",
        "density.every=4",
    )
    run(tmp_path, *TINY, "method=3dgs", "data.downscale=2", "max_steps=12", *often)
    tags = events(tmp_path).Tags()["scalars"]
    panels = chain.from_iterable(category.items() for category in LAYOUT.values())
    empty = [name for name, (_, patterns) in panels if not any(re.search(p, tag) for p in patterns for tag in tags)]
    assert empty == []
