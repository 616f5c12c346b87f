"""The imaging field: factor one at first, bounded always, no gradient to places, only what is in view, time sources."""

import math

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.coordinates import octaves
from heatsplat.thermal.imaging_field import ImagingField
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.static import Static

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def make_scene(times=(0.0, 10.0, 40.0)):
    frames = [Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)]
    views = ViewSet(frames, lambda index: None)
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(5)) * 3.0 + 7.0
    return SceneData("room", views, views.subset([0]), views.subset([1]), points)


def make(count=50, times=(0.0, 10.0, 40.0), emission=None, disturb=0.0, **options):
    """A field on a scene with its splats; ``disturb`` gives the last layer random weights of that size."""
    model = ImagingField(emission or Static(), **options)
    model.prepare(make_scene(times))
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator) * 3.0 + 7.0
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    splats = Splats(
        {name: item.initial for name, item in declared.items()}
        | {
            "means": means,
            "log_scales": torch.zeros(count, 3),
            "quats": torch.ones(count, 4),
            "opacity_logits": torch.zeros(count, 1),
        }
    )
    if disturb:
        with torch.no_grad():
            model.head.weight.normal_(0.0, disturb, generator=torch.Generator().manual_seed(3))
    return model, splats


def query(time_s=5.0, ids=None, frame_id=0):
    return Query(ids=ids, camera=CAMERA, time_s=time_s, frame_id=frame_id)


@pytest.mark.parametrize("options", [{}, {"exponent": "printed"}, {"applies_to": "harmonics"}, {"exponent_max": None}])
@pytest.mark.parametrize("count", [1, 7, 33, 100])  # odd counts end in the middle of a SIMD register
def test_the_factor_is_exactly_one_at_first(options, count):
    model, splats = make(count, **options)
    assert torch.equal(model.factor(splats.means, query()), torch.ones(count))
    if options.get("applies_to") != "harmonics":  # subtracting and adding 1/2 rounds
        emitted = model.emission.features(splats, query())
        assert torch.equal(model.features(splats, query()), emitted)


@pytest.mark.parametrize("exponent", ["positive", "printed"])
def test_all_four_quantities_learn_from_the_first_step_on(exponent):
    model, splats = make(exponent=exponent)
    model.features(splats, query()).sum().backward()
    moved = model.head.bias.grad.abs() > 1e-6
    # As printed, distance has no effect while both coefficients are zero.
    assert moved.tolist() == [True, True, exponent == "positive", True]
    assert model.head.weight.grad.abs().max() > 0


@settings(max_examples=40, deadline=None)
@given(scale=st.floats(0.0, 1e4), limit=st.floats(0.1, 4.0), seed=st.integers(0, 100))
def test_the_factor_is_bounded_and_positive_whatever_the_network_says(scale, limit, seed):
    model, splats = make(20, exponent="positive", exponent_max=limit)
    with torch.no_grad():
        model.head.weight.normal_(0.0, 1.0, generator=torch.Generator().manual_seed(seed)).mul_(scale)
    factor = model.factor(splats.means, query())
    start = model._exponent(model.start[None]).item()
    assert factor.isfinite().all() and (factor >= 0).all()
    assert factor.max() <= 2.0 * math.exp(start) * (1 + 1e-6)
    factor.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in model.layers.parameters())


def test_attenuation_only_weakens_while_sensitivity_stays():
    model, splats = make()
    with torch.no_grad():
        model.head.bias[:3] += 3.0
    assert (model.factor(splats.means, query()) < 0.1).all()


def test_the_formula_agrees_with_fifty_digits():
    model, splats = make(8, exponent="positive", disturb=0.5)
    raw = model._network(model._code_of(splats.means.detach()), model._moment_of(query())).double()
    got = model.factor(splats.means, query())
    with mpmath.workdps(50):

        def exponent(row):
            a, s, d = (mpmath.log1p(mpmath.exp(x)) for x in row[:3])
            return 4 * mpmath.tanh((a + s) * d / 4)

        for row, value in zip(raw.tolist(), got.tolist(), strict=True):
            sensitivity = 2 / (1 + mpmath.exp(-row[3]))
            expected = sensitivity * mpmath.exp(exponent(model.start.tolist()) - exponent(row))
            assert value == pytest.approx(float(expected), rel=2e-6)


def test_octaves_agree_with_fifty_digits_and_lose_nothing_at_high_frequencies():
    values = torch.tensor([[0.1234567, -0.89], [0.5, 12.345]])
    got = octaves(values, 10).reshape(2, 2, 2, 10)  # row, column, sin or cos, octave
    with mpmath.workdps(50):
        for row in range(2):
            for column in range(2):
                for k in range(10):
                    angle = mpmath.pi * mpmath.mpf(values[row, column].item()) * 2**k
                    assert got[row, column, 0, k].item() == pytest.approx(float(mpmath.sin(angle)), abs=4e-7)
                    assert got[row, column, 1, k].item() == pytest.approx(float(mpmath.cos(angle)), abs=4e-7)


def test_places_get_no_gradient_from_the_field():
    model, splats = make(disturb=0.3)
    model.features(splats, query()).sum().backward()
    assert splats.means.grad is None
    assert splats["sh0"].grad.abs().max() > 0


def test_only_gaussians_in_view_are_evaluated_and_the_time_once():
    model, splats = make(50, disturb=0.3)
    rows = []
    model.head.register_forward_hook(lambda module, inputs, output: rows.append(output.shape[0]))
    ids = torch.tensor([4, 17, 3])
    some = model.features(splats, query(ids=ids))
    assert rows == [3]
    every = model.features(splats, query())
    assert torch.allclose(some, every[ids], atol=1e-6)


def test_scaling_coefficients_leaves_the_constant_half_alone():
    on_radiance, splats = make(disturb=0.3)
    on_harmonics, _ = make(disturb=0.3, applies_to="harmonics")
    factor = on_radiance.factor(splats.means, query())[:, None]
    emitted = on_radiance.emission.features(splats, query())
    assert torch.allclose(on_radiance.features(splats, query()), factor * emitted)
    printed = (0.28209479177387814 * splats["sh0"][:, 0] * factor + 0.5).clamp(min=0)  # Eq. 12 at degree 0
    assert torch.allclose(on_harmonics.features(splats, query()), printed, atol=1e-6)
    assert not torch.allclose(printed, factor * emitted, atol=1e-3)


def test_what_is_printed_is_cut_off_after_coefficients_were_scaled():
    """Eq. 12 weakens what lies below zero, too: as published, a Gaussian with a negative sum may show."""
    model, splats = make(disturb=0.3, emission=Static(floor=False), applies_to="harmonics")
    with torch.no_grad():
        splats["sh0"][:25] -= 3.0
    sums = 0.28209479177387814 * splats["sh0"][:, 0]
    factor = model.factor(splats.means, query())[:, None]
    printed = (sums * factor + 0.5).clamp(min=0)
    assert ((sums < -0.5) & (printed > 0)).any()
    emitted = model.features(splats, query())
    assert torch.allclose(emitted, printed, atol=1e-6)
    emitted.sum().backward()
    assert (splats["sh0"].grad[:, 0][printed > 0] > 0).all()


def test_time_changes_the_factor_and_can_be_absent():
    model, splats = make(disturb=0.3)
    assert not torch.allclose(
        model.factor(splats.means, query(5.0)), model.factor(splats.means, query(35.0)), atol=1e-4
    )
    still, splats = make(disturb=0.3, time="none")
    assert len(still.moment_layers) == 0
    assert torch.equal(still.factor(splats.means, query(5.0)), still.factor(splats.means, query(None)))


@pytest.mark.parametrize(("frames", "kept"), [(63, 5), (33, 5), (32, 4), (16, 3), (2, 1), (1, 1), (5000, 10)])
@pytest.mark.parametrize("timed", [True, False])
def test_time_keeps_octaves_with_four_images_to_a_cycle(frames, kept, timed):
    """Octave k goes through 2^(k - 1) cycles over the record: 16 of them take 63 images at least, the first three."""
    times = [10.0 * i if timed else None for i in range(frames)]
    model, splats = make(times=(*times, times[0]), skip=1)  # a moment that is seen twice counts once
    if not timed:
        kept = {63: 5, 33: 5, 32: 5, 16: 4, 2: 1, 1: 1, 5000: 10}[frames]  # but each image has an index of its own
    assert model.slow_octaves == kept
    cycles = 2.0 ** (kept - 1) / 2
    assert kept == 1 or (frames + (not timed) - 1) / cycles >= 4 and (kept == 10 or (frames - timed) / cycles < 8)
    assert model.features(splats, query(0.0)).isfinite().all()


def test_the_network_sees_slow_octaves_alone():
    times = torch.linspace(0.0, 40.0, 17).tolist()
    slow, splats = make(times=times, disturb=0.3, skip=1)
    every, _ = make(times=times, disturb=0.3, skip=1, frames_per_cycle=None)
    assert torch.equal(slow._moment_of(query())[:4], every._moment_of(query())[:4])
    before = [model.factor(splats.means, query()).detach() for model in (slow, every)]
    with torch.no_grad():
        for model in (slow, every):
            for layer in model.moment_layers.values():
                layer.weight.view(-1, 2, 10)[..., 4:] += 1.0
    assert torch.equal(slow.factor(splats.means, query()), before[0])
    assert not torch.allclose(every.factor(splats.means, query()), before[1], atol=1e-3)


def test_without_times_the_index_of_the_frame_takes_their_place():
    model, splats = make(times=(None, None, None), disturb=0.3)
    assert model.effects()["attenuation"]["time"] == "index"
    seen = [model.factor(splats.means, query(None, frame_id=i)) for i in range(3)]
    assert not torch.allclose(seen[0], seen[1], atol=1e-4)
    for stranger in (None, 99):  # a view that no one took: the middle of the record
        assert torch.equal(model.factor(splats.means, query(None, frame_id=stranger)), seen[1])
    with pytest.raises(SceneError, match="ImagingField needs time"):
        ImagingField(Static(), time="seconds").check(make_scene((None, None)))


def test_a_scene_of_one_moment_or_one_frame_is_finite():
    for times in ((3.0,), (3.0, 3.0), (None,)):
        frames = [Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)]
        views = ViewSet(frames, lambda index: None)
        model = ImagingField(Static())
        model.prepare(SceneData("one", views, views, views, torch.zeros(4, 3)))
        assert model.factor(torch.zeros(2, 3), query(3.0)).isfinite().all()


def test_the_box_makes_the_code_one_to_one_and_far_points_stay_in_it():
    model, splats = make()
    low, high = torch.quantile(make_scene().points, torch.tensor([0.01, 0.99]), dim=0)
    inside = (torch.stack((low, high)) - model.box.center) / model.box.edge
    assert inside.abs().max().item() == pytest.approx(0.5, abs=1e-6)
    far = torch.tensor([[1e6, -1e6, 0.0], [-1e6, 1e6, 0.0]])
    assert not torch.allclose(*model._code_of(far), atol=0.1)  # the two ends do not share a code
    world, _ = make(positions="world")
    assert torch.allclose(world._code_of(splats.means), octaves(splats.means.detach(), 10))


def test_the_gauge_pulls_the_mean_sensitivity_to_one():
    model, splats = make(exponent="positive")
    with torch.no_grad():
        model.head.bias[3] = 1.0
    model.features(splats, query())
    terms = model.regularisers(splats)
    sensitivity = 2 / (1 + math.exp(-1.0))
    assert terms["sensitivity_gauge"].item() == pytest.approx(1e-3 * (sensitivity - 1) ** 2, rel=1e-5)
    terms["sensitivity_gauge"].backward()
    assert model.head.bias.grad[3] > 0
    assert model.regularisers(splats) == {}  # nothing was evaluated since
    with torch.no_grad():
        model.features(splats, query())
    assert model.regularisers(splats) == {}
    off, splats = make(gauge=0.0)
    off.features(splats, query())
    assert off.regularisers(splats) == {}


def test_it_wraps_any_emission_and_speaks_for_it():
    model, splats = make(emission=NewtonHarmonic(frequencies=2))
    assert set(splats.names) >= {"initial_state", "log_rate", "source_gains"}
    assert model.needs == {"time"}
    assert set(model.effects()) == {"relaxation", "harmonic_source", "attenuation"}
    assert model.features(splats, query()).shape == (50, 1)
    harmonics, _ = make(emission=Static(sh_degree=2, sh_degree_interval=10))
    harmonics.on_step(10)
    assert harmonics.emission.active_degree == 1


def test_companions_pass_untouched():
    class Joint(Static):
        """Two images on one geometry, as a joint method has them."""

        def __init__(self):
            super().__init__()
            self.companions, self.modality_channels = ("rgb",), (1, 3)

        def features(self, splats, query):
            emitted = super().features(splats, query)
            return torch.cat((emitted, emitted.expand(-1, 3)), 1)

    _, splats = make()
    model = ImagingField(Joint(), exponent="positive")
    with torch.no_grad():
        model.head.bias[3] = 1.0
    features = model.features(splats, query())
    assert torch.allclose(features[:, 0], 2 / (1 + math.exp(-1.0)) * features[:, 1], rtol=1e-5)
    assert (model.companions, model.modality_channels) == (("rgb",), (1, 3))


def test_the_factor_is_told_for_pictures_without_leaving_a_trace():
    model, splats = make(disturb=0.3)
    told = model.attributes(splats, query(ids=torch.tensor([2, 5])))
    assert set(told) == {"imaging_factor"} and not told["imaging_factor"].requires_grad
    assert torch.equal(told["imaging_factor"], model.factor(splats.means[[2, 5]], query()))
    model.regularisers(splats)
    model.attributes(splats, query())
    assert model.regularisers(splats) == {}


def test_the_network_starts_from_the_generator_it_is_given():
    first, _ = make()
    torch.manual_seed(123)
    second, _ = make()
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_cost_counts_the_multiply_adds_of_the_layers():
    narrow = ImagingField(Static())
    assert narrow.cost == Static().cost + 60 * 32 + 32 * 32 + 32 * 4 + 80
    paper = ImagingField(Static(), width=256, depth=8, skip=5)
    assert 0.48e6 < paper.cost < 0.50e6
    wide, splats = make(width=32, depth=4, skip=2, disturb=0.2)
    assert wide.layers[2].in_features == 92 and wide.features(splats, query()).isfinite().all()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"time": "frames"}, "time must be one of auto, seconds, index, none, got 'frames'"),
        ({"exponent": "free"}, "exponent must be one of positive, printed"),
        ({"applies_to": "sh"}, "applies_to must be one of radiance, harmonics"),
        ({"positions": "sphere"}, "positions must be one of box, world"),
        ({"width": 0}, "must be at least 1, got 0, 2, 10, 10"),
        ({"skip": 2}, "skip must name a hidden layer from 1 to 1, or be null, got 2"),
        ({"exponent_max": 0.0}, "exponent_max must be positive or null, got 0.0"),
        ({"gauge": -1e-3}, "gauge is a weight and must not be negative, got -0.001"),
    ],
)
def test_unknown_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        ImagingField(Static(), **options)


def test_a_time_that_is_missing_is_asked_for():
    model, splats = make()
    with pytest.raises(ValueError, match="give time_s"):
        model.features(splats, query(None))
