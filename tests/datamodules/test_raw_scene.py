import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.raw_scene import Counts, SceneOptions
from heatsplat.datamodules.splits import SplitRule


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("downscale", 0.5, "data.downscale must be 1 or larger, got 0.5"),
     ("downscale", float("nan"), "data.downscale must be 1 or larger, got nan"),
     ("thermal_channels", 2, "data.thermal_channels must be 1 or 3, got 2")],
)  # fmt: skip
def test_options_out_of_their_range_are_refused(option, value, message):
    with pytest.raises(SceneError, match=message):
        SceneOptions(SplitRule("every_8th"), **{option: value})


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf")])
def test_a_scale_of_counts_must_be_positive_and_finite(scale):
    with pytest.raises(SceneError, match=f"data.raw_scale must be positive .°C per count., got {scale}"):
        Counts(scale, 0.0)
