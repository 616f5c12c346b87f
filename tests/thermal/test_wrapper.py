"""Models around models: every hook, rate, penalty and row of the model inside comes out, whatever is around it."""

import importlib
import pkgutil
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch import nn

import heatsplat.thermal
from heatsplat.contracts import Camera, Course, Frame, SceneData, SceneError, ThermalRange, View, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.atmospheric_field import AtmosphericField
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Geometry, Heat, PerGaussian, Query, Rate, Seeds, ThermalModel
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.conduction import Conducting
from heatsplat.thermal.embedded import Embedded
from heatsplat.thermal.hexplane import HexPlane
from heatsplat.thermal.imaging_field import ImagingField
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.radiative import Radiative
from heatsplat.thermal.radiative_transfer import RadiativeTransfer
from heatsplat.thermal.reflection import Reflection
from heatsplat.thermal.static import Static
from heatsplat.thermal.through_air import ThroughAir
from heatsplat.thermal.time_mlp import TimeMlp
from heatsplat.thermal.wrapper import Wrapper

COUNT = 12
CAMERA = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
QUERY = Query(None, CAMERA, 5.0, 1)
MOVED = Geometry(torch.ones(COUNT, 3), torch.ones(COUNT, 4), torch.ones(COUNT, 3), torch.ones(1, COUNT))
DROPPED = ("probe", torch.arange(COUNT) < 3, {})

PROBED = Course("depth of the probe", [0.0, 5.0], [1.0, 2.0], "m")


class Probe(ThermalModel):
    """Answers every hook as nothing else does, and remembers what it was told."""

    needs = frozenset({"time", "ambient"})
    narrowest_range_k = 0.25
    optional = frozenset({"probed"})
    inseparable = "it is probed as a whole"
    beyond_record = "it probes on"
    start_opacity, averaged = 0.35, 0.75

    def __init__(self, modality="thermal"):
        super().__init__()
        self.modality, self.modality_channels = modality, (3,) if modality == "rgb" else (1,)
        self.own = nn.Parameter(torch.ones(()))
        self.told = []

    def check(self, scene):
        super().check(scene)
        self.told.append("check")

    def prepare(self, scene):
        self.told.append("prepare")

    def on_step(self, step):
        self.told.append(step)

    def on_rows_changed(self):
        self.told.append("rows")

    def per_gaussian(self, seeds):
        return {"probe": PerGaussian(seeds.values.clone(), 0.77, l2=0.66, lr_end=0.55)}

    def features(self, splats, query):
        self.told.append("features")
        return query.rows(splats["probe"])

    def geometry(self, splats, query):
        return MOVED

    def temperature(self, splats, time_s, ids=None):
        return torch.full((COUNT,), 321.0 + time_s)

    def temperatures(self, splats, times_s, ids=None):
        self.told.append("times together")
        return super().temperatures(splats, times_s, ids)

    @property
    def removable(self):
        return ("needle",)

    @contextmanager
    def without(self, name):
        self.told.append(f"without {name}")
        yield

    def regularisers(self, splats):
        return {"probe/term": 0.25 * self.own}

    def rows_to_drop(self, splats, step):
        yield DROPPED

    def attributes(self, splats, query):
        return {"probed": query.rows(splats.means)[:, 0]}

    def quotients(self, told):
        return {"halved": told["probed"] / 2}

    def prior(self, splats):
        return {"probed": splats.means[:, 1]}

    def doubts(self):
        return {"needle": partial(self.without, "needle")}

    def rate_of(self, name):
        return {"own": Rate(0.123, 0.456, paced=True, held=0.7)}[name]

    def effects(self):
        return {"probing": {"how": "deep"}}

    def courses(self):
        return [PROBED]

    @property
    def cost(self):
        return 10**9


AROUND = {
    "AtmosphericField": AtmosphericField,
    "ImagingField": ImagingField,
    "TimeMlp": TimeMlp,
    "HexPlane": lambda inner: HexPlane(inner, heads=["radiance"]),
    "Conducting": lambda inner: Conducting(inner, neighbours=2),
    "Composed": lambda inner: Composed(inner, {"reflection": Reflection()}),
    "Composed with a companion": lambda inner: Composed(inner, companion=Static(channels=3, modality="rgb")),
    "Embedded": Embedded,
    "Radiative": Radiative,
    "RadiativeTransfer": lambda inner: RadiativeTransfer(inner, Attenuation()),
    "ThroughAir": lambda inner: ThroughAir(inner, Attenuation()),
    "two of them": lambda inner: ImagingField(Conducting(inner, neighbours=2)),
}


def make_scene(timed=True):
    generator = torch.Generator().manual_seed(0)
    frames = [Frame(f"{i}.png", i, CAMERA, 5.0 * i if timed else None) for i in range(4)]
    image = torch.full((16, 16, 1), 0.5)
    views = ViewSet(frames, lambda i: View(frames[i], image, image.expand(-1, -1, 3)))
    points = torch.randn(30, 3, generator=generator)
    return SceneData("yard", views, views, views, points, None, ThermalRange(10.0, 30.0), 20.0)


@pytest.fixture(params=AROUND)
def wrapped(request):
    """A probe in a wrapper, on a scene with splats."""
    probe = Probe("rgb" if request.param == "Radiative" else "thermal")
    model, scene = AROUND[request.param](probe), make_scene()
    model.check(scene)
    model.prepare(scene)
    generator = torch.Generator().manual_seed(1)
    means = torch.randn(COUNT, 3, generator=generator) + torch.tensor([0, 0, 5.0])
    values = 0.2 + 0.6 * torch.rand(COUNT, sum(model.modality_channels), generator=generator)
    declared = model.per_gaussian(Seeds(means, values, generator))
    shapes = {"means": means, "log_scales": torch.zeros(COUNT, 3), "quats": torch.ones(COUNT, 4)}
    shapes["opacity_logits"] = torch.zeros(COUNT, len(model.opacity_channels))
    splats = Splats(shapes | {name: item.initial for name, item in declared.items()})
    return SimpleNamespace(model=model, probe=probe, declared=declared, values=values, splats=splats)


def test_all_wrappers_are_tried():
    for module in pkgutil.iter_modules(heatsplat.thermal.__path__):
        importlib.import_module(f"heatsplat.thermal.{module.name}")

    def below(kind):
        return {kind.__name__}.union(*(below(other) for other in kind.__subclasses__()))

    assert below(Wrapper) - {"Wrapper"} == {name for name in AROUND if " " not in name}


def test_no_hook_of_a_model_is_left_out():
    """A new hook of models must come to the wrapper and to the probe, too."""
    hooks = {name for kind in (Heat, ThermalModel) for name in vars(kind) if not name.startswith("_")}
    own = {"lr", "lr_end", "paced", "held"}  # of the wrapper's own parameters; see rate_of
    made = {
        "modality",
        "companions",
        "modality_channels",
        "shared_opacity",
        "start_opacity",
        "averaged",
        "needs",
        "narrowest_range_k",
        "optional",
        "inseparable",
        "stays_here",
    }
    hooks -= own | {"images", "opacity_channels"}  # which follow from others
    hooks -= {"rows", "per_row"}  # those of one Gaussian for each row: others cannot be wrapped
    assert hooks - made <= vars(Wrapper).keys()
    assert hooks - made <= vars(Probe).keys()
    assert made <= vars(Wrapper({"inner": Static()})).keys()


def test_what_the_model_inside_answers_comes_out(wrapped):
    model, probe, splats = wrapped.model, wrapped.probe, wrapped.splats
    assert model.needs >= probe.needs and model.narrowest_range_k == 0.25 and model.optional == probe.optional
    clauses = [type(one).inseparable for one in model.modules() if isinstance(one, Wrapper)]  # from the outside in
    assert model.inseparable == next(filter(None, [*clauses, probe.inseparable]))
    assert (model.start_opacity, model.averaged) == (0.35, 0.75) and model.geometry(splats, QUERY) is MOVED
    if not isinstance(model, ThroughAir):  # whose surfaces are warmer than they are seen
        assert torch.equal(model.temperature(splats, 5.0), probe.temperature(splats, 5.0))
    together = model.temperatures(splats, [5.0, 9.0])
    assert torch.equal(together, torch.stack([model.temperature(splats, time_s) for time_s in (5.0, 9.0)]))
    if all(type(one).temperature is Wrapper.temperature for one in model.modules() if isinstance(one, Wrapper)):
        assert probe.told[-1] == "times together"
    if not isinstance(model, Composed):  # which has parts of its own to leave out
        assert model.removable == ("needle",)
        with model.without("needle"):
            assert probe.told[-1] == "without needle"
    assert PROBED in model.courses()
    model.features(splats, QUERY)
    assert model.regularisers(splats)["probe/term"].grad_fn is not None
    assert list(model.rows_to_drop(splats, 3)) == [DROPPED]
    ids = torch.tensor([4, 1])
    attributes = model.attributes(splats, Query(ids, CAMERA, 5.0, 1))
    assert torch.equal(attributes["probed"], splats.means[ids, 0])
    assert torch.equal(model.quotients(attributes)["halved"], splats.means[ids, 0] / 2)
    assert torch.equal(model.prior(splats)["probed"], splats.means[:, 1])
    assert model.doubts()["needle"].func.__self__ is probe
    assert model.effects()["probing"] == {"how": "deep"}
    assert model.cost >= 10**9
    # A companion is silent.
    assert model.beyond_record.startswith("it probes on") and "emits" not in model.beyond_record


def test_wrappers_and_parts_say_what_they_assume_beyond_the_record():
    scene = make_scene()
    air = Attenuation()
    air.prepare(scene)
    model = Conducting(Composed(NewtonHarmonic(), {"air": air, "reflection": Reflection()}))
    state, of_air, of_neighbours = model.beyond_record.split("; ")
    assert (state, of_air) == (NewtonHarmonic.beyond_record, air.beyond_record)
    assert "nearest" in of_air and "neighbours" in of_neighbours
    untimed = AtmosphericField(Static())
    untimed.prepare(make_scene(timed=False))
    assert untimed.beyond_record == Static.beyond_record


@pytest.mark.parametrize(
    "build", [TimeMlp, lambda inner: HexPlane(inner, heads=["radiance"]), AtmosphericField, ImagingField]
)
@pytest.mark.parametrize(("beyond_s", "nearest_s"), [(-40.0, 0.0), (99.0, 15.0)])
def test_a_field_over_time_holds_its_ends_beyond_the_record(build, beyond_s, nearest_s):
    model = build(Static(floor=False))
    model.prepare(make_scene())
    generator = torch.Generator().manual_seed(1)
    declared = model.per_gaussian(Seeds(torch.randn(COUNT, 3, generator=generator), torch.rand(COUNT, 1), generator))
    tensors = {"means": torch.randn(COUNT, 3, generator=generator), "log_scales": torch.zeros(COUNT, 3)}
    tensors |= {"quats": torch.ones(COUNT, 4), "opacity_logits": torch.zeros(COUNT, 1)}
    splats = Splats(tensors | {name: item.initial for name, item in declared.items()})
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)

    def at(time_s):
        return model.features(splats, Query(None, CAMERA, time_s, 1))

    assert torch.equal(at(beyond_s), at(nearest_s))
    assert not torch.equal(at(5.0), at(nearest_s))


def test_what_the_model_inside_is_told_comes_in(wrapped):
    wrapped.model.on_step(17)
    wrapped.model.features(wrapped.splats, QUERY)
    wrapped.model.on_rows_changed()
    assert wrapped.probe.told == ["check", "prepare", 17, "features", "rows"]


def test_tensors_and_parameters_keep_their_rates_and_penalties(wrapped):
    item, names = wrapped.declared["probe"], dict(wrapped.model.named_parameters())
    assert (item.lr, item.l2, item.lr_end) == (0.77, 0.66, 0.55)
    first = 1 if isinstance(wrapped.model, Radiative) else 0  # colours come after heat
    assert torch.equal(item.initial, wrapped.values[:, first : first + item.initial.shape[1]])
    (own,) = (name for name in names if name.endswith(".own"))
    assert wrapped.model.rate_of(own) == Rate(0.123, 0.456, paced=True, held=0.7)
    assert all(isinstance(wrapped.model.rate_of(name), Rate) for name in names)


def test_a_learned_ambient_keeps_its_rate_in_a_field():
    model = ImagingField(NewtonHarmonic(ambient="learned"))
    model.prepare(make_scene())
    assert model.rate_of("emission.ambient") == Rate(1e-3, 0.1)
    assert model.rate_of("head.weight") == Rate(8e-4, 2e-3, paced=True, held=0.7)


def test_a_scene_that_the_model_inside_cannot_do_with_is_refused(wrapped):
    with pytest.raises(SceneError, match="Probe needs time"):
        wrapped.model.check(make_scene(timed=False))


def test_two_members_with_a_tensor_of_the_same_name_are_refused():
    model = Composed(Static(), companion=Static(channels=3, modality="rgb"))
    with pytest.raises(ValueError, match="call a tensor sh0: give one a prefix"):
        model.per_gaussian(Seeds(torch.zeros(2, 3), torch.rand(2, 4), torch.Generator()))


def test_two_members_with_a_loss_term_of_the_same_name_are_refused():
    """Added up by name, one would be lost."""
    model = ThroughAir(ThroughAir(Static(), Attenuation(moments=3, smooth=1.0)), Attenuation(moments=3, smooth=1.0))
    with pytest.raises(ValueError, match="two members of ThroughAir call a loss term extinction_smooth"):
        model.regularisers(None)
