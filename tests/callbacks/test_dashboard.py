"""The layout of TensorBoard: every panel finds a curve that training really writes."""

import re
from itertools import chain

from fake_run import FakeModule, events, fit, trainer, wall
from running import TINY, run

from heatsplat.callbacks.dashboard import LAYOUT, Dashboard


def test_the_layout_is_written_once_per_run(tmp_path):
    fit(FakeModule(wall(), tmp_path), trainer(tmp_path, [Dashboard()], steps=2, every=2))
    tags = events(tmp_path).Tags()["tensors"]
    assert tags.count("custom_scalars__config__") == 1


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
