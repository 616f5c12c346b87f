"""A run with cast shadows, looked at under another weather."""

import pytest
import torch
from running import QUIET, run

from heatsplat.geometry.exposure import sun_directions
from heatsplat.runs.run import load


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shadows")
    module, _ = run(
        folder,
        *QUIET,
        "method=energy_balance",
        "data.downscale=2",
        "thermal.shadows=true",
        "thermal.albedo=0.3",  # as other tests of shadows have it, which share its kernels
        "init.count=100",
        "exposure.side=32",
        "normals.views=4",
        "callbacks.attributes=null",
        "max_steps=2",
    )
    return folder / "checkpoints" / "last.ckpt", module


def test_a_weather_with_other_suns_keeps_the_directions_that_were_looked_at(trained, tmp_path):
    checkpoint, module = trained
    start, ends = module.scene.weather.notes["utc_at_zero_s"], module.scene.weather.times_s[[0, -1]].tolist()
    hours = range(int(start + ends[0]) - 20 * 86400, int(start + ends[1]) + 3600, 3600)  # twenty days longer
    table = tmp_path / "summer.csv"
    table.write_text(
        "time_utc,air_c,humidity_percent,wind_m_s\n" + "".join(f"{hour},{15 + hour % 7},60,2\n" for hour in hours)
    )
    other = load(checkpoint, weather=table)
    heat = other.module.thermal
    assert len(sun_directions(other.scene.weather.sun, other.scene.weather.up)) > len(module.thermal.sun_ways)
    assert torch.equal(heat.sun_ways, module.thermal.sun_ways)
    assert torch.equal(other.module.splats["sun_seen"], module.splats["sun_seen"])
    assert other.render(other.scene.test.frames[0], unseen="keep").isfinite().all()
