"""Parameters that the optimiser cannot know, or that no image depends on, are named."""

import logging

import pytest
import torch
from running import TINY
from torch import nn

from heatsplat.callbacks.finite import NotFinite
from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.density.base import DensityChange, DensityControl
from heatsplat.runs.run import begin
from heatsplat.thermal.static import Static
from heatsplat.training.session import fit

SHORT = (*TINY, "method=3dgs", "data.downscale=4", "max_steps=3", "test=false", "logger=none")


class Listed(Static):
    def __init__(self):
        super().__init__()
        self.gains = [nn.Parameter(torch.ones(()))]


class Late(Static):
    def features(self, splats, query):
        if not hasattr(self, "gain"):
            self.gain = nn.Parameter(torch.ones(()))
        return self.gain * super().features(splats, query)


class Detached(Static):
    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(()))

    def features(self, splats, query):
        return super().features(splats, query).detach()


class Broken(Static):
    def features(self, splats, query):
        return super().features(splats, query) * float("nan")


class Emptying(DensityControl):
    def refine(self, cloud, step, extent, generator):
        count = len(cloud)
        cloud.keep(torch.zeros(count, dtype=torch.bool))
        return DensityChange(removed=count)


class Yes(DensityControl):
    def refine(self, cloud, step, extent, generator):
        return True


class Silent(DensityControl):
    def refine(self, cloud, step, extent, generator):
        cloud.keep(torch.arange(len(cloud)) > 4)


class Misspelt(Static):
    needs = frozenset({"times"})


class Flat(Static):
    def features(self, splats, query):
        return super().features(splats, query)[:, 0]


class Everywhere(Static):
    def features(self, splats, query):
        return splats["sh0"].new_zeros(len(splats), 1)


class Short(DensityControl):
    def initial_state(self, count, device):
        return {"seen": torch.zeros(3)}


def trained(model, folder, density=None):
    begun = begin(compose(SHORT), folder)
    begun.module.thermal = model
    begun.module.density = density or begun.module.density
    fit(begun.module, begun.data, begun.trainer, test=False)


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (Listed, r"thermal.gains of Listed holds parameters in a list, .* use nn.ParameterList"),
        (Late, r"the optimiser does not know the parameters thermal.gain, .* in __init__ or prepare"),
    ],
)
def test_parameters_that_the_optimiser_does_not_know_are_refused(model, told, tmp_path):
    with pytest.raises(ValueError, match=told):
        trained(model(), tmp_path)


def test_parameters_without_a_gradient_are_warned_of_at_the_end(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        trained(Static(), tmp_path / "sound")
        assert "had no gradient" not in caplog.text
        trained(Detached(), tmp_path / "detached")
    assert "sh0, thermal.gain had no gradient in this run, and learned nothing" in caplog.text


def test_emission_that_is_not_finite_is_named_before_the_gradients_of_the_geometry(tmp_path):
    with pytest.raises(NotFinite, match=r"step 1: what Broken.features returns has \d+ NaN"):
        trained(Broken(), tmp_path)


def test_metadata_that_no_scene_can_have_are_named(tmp_path):
    with pytest.raises(ValueError, match="each of Misspelt.needs must be one of time, thermal_range, .*, got 'times'"):
        trained(Misspelt(), tmp_path)


def test_emission_of_another_shape_names_the_model(tmp_path):
    told = r"{}.features returns must be \[(\d+), 1\], a row for each Gaussian in view .*, got \[{}\]"
    with pytest.raises(ValueError, match=told.format("Flat", r"\1")):
        trained(Flat(), tmp_path / "flat")
    with pytest.raises(ValueError, match=told.format("Everywhere", r"\d+, 1")):
        trained(Everywhere(), tmp_path / "everywhere")


def test_density_control_that_leaves_nothing_or_has_other_rows_is_named(tmp_path):
    with pytest.raises(SceneError, match="Emptying removed all Gaussians in step 1"):
        trained(Static(), tmp_path / "emptying", Emptying())
    with pytest.raises(ValueError, match="Yes.refine returned True: return DensityChange"):
        trained(Static(), tmp_path / "yes", Yes())
    with pytest.raises(
        ValueError, match="Silent.refine returned None and left 5 Gaussians fewer: return DensityChange"
    ):
        trained(Static(), tmp_path / "silent", Silent())
    with pytest.raises(ValueError, match=r"'seen' of Short.initial_state is \[3\]; it needs a row for each of the \d+"):
        trained(Static(), tmp_path / "short", Short())
