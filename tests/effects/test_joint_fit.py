"""The joint fit, rule by rule: each test fails where its rule is left out."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from effects.tracks import FRAMES, PASSED, POINTS, drawn, fit_to, levels, positions

from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.joint import least_squares, selection
from heatsplat.effects.joint.certainty import Certainty, Worth
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.courses import ANY
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.held_out import HeldOut
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import candidates, earns, pruned, selected
from heatsplat.effects.physical import agc, fixed_pattern, frame_offset, tone, view_dependence, vignetting

EFFECTS = {effect.name: effect for effect in CATALOGUE if effect.term is not None}
OWN = {"relaxation", "harmonic_source", "view_dependence"}
CHANGING = Model.of(relaxation=1)
RAMP = PASSED - PASSED.mean()
DRIFT = 0.1 * drawn(FRAMES, seed=7)  # from frame to frame
FALLOFF = 1 - 0.3 * (positions() ** 2).sum(2) / 2


def cooling(amount=0.4):
    """Points that relax, each at its own rate."""
    return levels() - amount * levels(8) * (1 - torch.exp(-PASSED * (2.0 + drawn(POINTS, 1, seed=9).abs())))


@pytest.fixture(scope="module")
def still():
    return fit_to(levels(), still=True)


@pytest.fixture(scope="module")
def moving():
    return fit_to(levels())


@pytest.fixture
def figures(monkeypatch):
    """Gains and sizes that a test sets; ``changes`` is how much the scene of the model CHANGING changes."""
    said = SimpleNamespace(gain=100.0, size=1.0, changes=0.0)
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: said.gain)
    monkeypatch.setattr(Fit, "effect_size", lambda fit, more, less: (more == CHANGING and said.changes) or said.size)
    monkeypatch.setattr(Fit, "may_change", lambda fit, model: False)  # or ``in_common`` would look at the tracks
    return said


def taken(fit, less=Model(), names=EFFECTS):  # noqa: B008
    return {name for name in names if earns(fit, less.plus(name), less, name)}


# What an effect has to show ---------------------------------------------------------------------------------


def test_numbers_of_single_points_have_a_higher_hurdle_than_numbers_of_all(moving, figures):
    figures.gain = 1.8  # edges give a point's own numbers that much where nothing is to be found
    assert taken(moving) == set(EFFECTS) - OWN - {"fixed_pattern"}
    figures.gain = 1.2
    assert not taken(moving)
    figures.gain = 2.6
    assert taken(moving) == set(EFFECTS)


def test_what_is_small_beside_the_noise_is_left_out(moving, figures):
    figures.size = 0.15
    assert taken(moving) == set(EFFECTS) - {"attenuation", "reflection"}  # misplaced points look a little like them
    figures.size = 0.09
    assert not taken(moving)


SHARES = {
    "fixed_pattern": 0.008,
    "vignetting": 0.008,
    "tone": 0.01,
    "frame_offset": 0.03,
    "reflection": 0.04,
    "agc": 0.1,
}
SHARES |= {"harmonic_source": 0.15}


@pytest.mark.parametrize("name", SHARES)
def test_what_is_small_beside_the_changes_of_the_scene_is_left_out(moving, figures, name):
    for share in (0.99 * SHARES[name], 1.01 * SHARES[name]):
        figures.changes = figures.size / share
        assert taken(moving, CHANGING, [name]) == ({name} if share > SHARES[name] else set())
        assert taken(moving, Model(), [name])  # a scene that does not change asks for no more


def test_beside_a_weather_record_every_effect_must_be_a_fifth_of_the_changes(figures):
    driven = fit_to(levels(), drivers=torch.stack([RAMP, RAMP**2], 1))
    others = set(EFFECTS) - {"relaxation"}
    figures.changes = figures.size / 0.19
    assert not taken(driven, CHANGING, others)
    figures.changes = figures.size / 0.21
    assert taken(driven, CHANGING, others) == others


def test_before_a_still_camera_a_drift_that_few_points_answer_less_is_no_heat():
    drift = 0.6 * RAMP * (1 + 0.2 * drawn(POINTS, 1, seed=8))
    fit, less = fit_to(levels() + drift, still=True), Model.of(frame_offset=1)
    for name in ("relaxation", "harmonic_source"):
        more = less.plus("relaxation").plus(name)
        assert fit.gain(more, less) > EFFECTS[name].threshold and fit.effect_size(more, less) > 0.1
        assert not earns(fit, more, less, name)
    cools = fit_to(levels() + 0.3 * drawn(POINTS, 1, seed=8) * torch.exp(-2 * PASSED), still=True)
    assert earns(cools, less.plus("relaxation"), less, "relaxation")


def test_what_only_some_points_show_is_not_the_cameras():
    flicker = DRIFT * (torch.arange(POINTS)[:, None] % 10 < 7)  # a lamp shines on seven points of ten
    less = CHANGING
    for course, held in ((flicker, False), (DRIFT, True)):
        fit = fit_to(cooling() + course)
        for name in ("frame_offset", "agc"):
            more = less.plus(name)
            assert fit.gain(more, less) > EFFECTS[name].threshold and fit.effect_size(more, less) > 0.1
            assert earns(fit, more, less, name) == held


# What the tracks can show -----------------------------------------------------------------------------------


def tried(fit, model=Model()):  # noqa: B008
    return {name for name, _ in candidates(fit, model)}


def test_a_camera_that_stands_still_shows_time_and_what_changes_from_image_to_image(still, moving):
    assert tried(still) == {"relaxation", "harmonic_source", "frame_offset", "agc"}
    assert tried(moving) == {"relaxation", "harmonic_source", "frame_offset", "agc"} | {
        "view_dependence", "fixed_pattern", "vignetting"
    }  # fmt: skip


def test_a_curve_shows_where_an_offset_moves_the_levels_along_it(moving):
    assert "tone" not in tried(moving)
    assert "tone" in tried(moving.accepted(Model.of(frame_offset=1)))


def test_mirrors_need_normals_and_haze_a_temperature_of_the_surroundings(moving):
    assert "reflection" in tried(fit_to(levels(), normals=drawn(POINTS, 3)))
    data = replace(moving.data, ambient=0.0)
    fit = replace(moving, data=data)
    haze = [more.kind("attenuation") for name, more in candidates(fit, Model()) if name == "attenuation"]
    assert haze == ["constant", "varying"]
    haze = [
        more.kind("attenuation")
        for name, more in candidates(fit, Model.of(attenuation="constant"))
        if name == "attenuation"
    ]
    assert haze == ["varying"]


def test_a_source_brings_what_it_stands_on_and_goes_with_it(moving):
    driven = [more for name, more in candidates(moving, Model()) if name == "harmonic_source"]
    assert driven == [Model.of(relaxation=1, harmonic_source=count) for count in (1, 2, 3)]
    assert moving.without(driven[0].plus("agc"), "relaxation") == Model.of(agc=1)


# The selection ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values, effects",
    [
        (lambda: levels(), set()),
        (lambda: cooling(), {"relaxation"}),
        (lambda: levels() + DRIFT, {"frame_offset"}),
        (lambda: levels() * (1 + 2 * DRIFT), {"agc"}),
        (lambda: levels() * FALLOFF, {"vignetting"}),
        (lambda: levels() * FALLOFF + DRIFT, {"vignetting", "frame_offset"}),
    ],
    ids=["nothing", "cooling", "drift", "gains", "falloff", "falloff and drift"],
)
def test_what_was_put_in_is_selected(values, effects):
    _, model = selected(fit_to(values()))
    assert model.names == effects


def test_the_selection_starts_from_nothing_twice_and_from_what_effects_name(still, moving, monkeypatch):
    begun = []

    def grown(fit, model, names):
        begun.append((model.names, set(names)))
        return fit, model

    monkeypatch.setattr(selection, "grown", grown)
    monkeypatch.setattr(selection, "pruned", lambda fit, model: model)
    everything, sensor = set(EFFECTS), {"fixed_pattern", "vignetting", "frame_offset", "tone"}
    from_nothing = [(set(), sensor), (set(), everything), (set(), set()), (set(), everything)]
    selected(still)
    drifts = {"relaxation", "frame_offset"}
    assert begun[:6] == [*from_nothing, (drifts, set()), (drifts, everything)]
    begun.clear()
    selected(moving)
    uneven = {"relaxation", "harmonic_source", "fixed_pattern"}
    assert begun[:6] == [*from_nothing, (uneven, set()), (uneven, everything)]


def test_effects_that_others_make_needless_are_dropped_the_least_first(moving, figures, monkeypatch):
    gains = {"agc": 0.5, "frame_offset": 1.0, "tone": 9.0}
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: min(gains[name] for name in more.names - less.names))
    dropped, without = [], Fit.without
    monkeypatch.setattr(Fit, "without", lambda fit, model, name: (dropped.append(name), without(fit, model, name))[1])
    assert pruned(moving, Model.of(agc=1, frame_offset=1, tone=1)) == Model.of(tone=1)


def test_outliers_and_points_that_nothing_explains_do_not_count():
    values, points = levels().repeat(1, FRAMES), torch.arange(12)
    values[points, 2 * points + 3] += 0.2
    values[20:24] += 0.3 * drawn(4, FRAMES, seed=6)
    weights = fit_to(values).weights
    assert not weights[points, 2 * points + 3].any() and not weights[20:24].any()
    assert (weights[points] > 0).any(1).sum() >= 6  # the rest of what they show counts


def test_a_state_does_not_change_when_the_next_one_is_made(moving):
    model = Model.of(frame_offset=1)
    before = moving.quality(model)
    after = moving.accepted(model)
    assert not moving.known and set(after.known) == {"frame_offset"}
    assert replace(moving).quality(model) == before != after.quality(model)


# Verdicts on effects that look alike ------------------------------------------------------------------------


SURE = SimpleNamespace(
    doubts={}, told={}, explained=True, unseen_changes="", few=lambda name: "", undecided=lambda more, name: False,
    worth=lambda name, more=None, less=None: Worth(HeldOut(db=3.0, sigmas=9.0, images=FRAMES)),
    idle=lambda name, more, less: False, clear=lambda more, name: False, beside_weather=lambda model: model,
    compared=lambda more, less: HeldOut(db=3.0, sigmas=9.0, images=FRAMES),
)  # fmt: skip


def look(fit, *names):
    """An inspection of what was fitted, by images that tell everything."""
    model = Model.of(**dict.fromkeys(names, 1))
    certainty = SimpleNamespace(fit=fit, model=model, **SURE.__dict__)
    return SimpleNamespace(joint=(fit, model), obs=SimpleNamespace(why=""), certainty=certainty, for_patterns=certainty)


def sized(monkeypatch, **sizes):
    """Each effect has this size, whatever stands beside it."""
    monkeypatch.setattr(
        Fit, "effect_size", lambda fit, more, less: max(sizes[name] for name in more.names - less.names)
    )


def test_direction_beside_larger_mirrors_makes_up_for_their_normals(moving, monkeypatch):
    for size, on in ((1.0, False), (3.0, True)):
        sized(monkeypatch, reflection=2.0, view_dependence=size)
        monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 5.0)
        assert (view_dependence.evidence(look(moving, "reflection", "view_dependence")).statistic > 2.5) == on


def test_mirrors_in_the_place_of_harmonics_leave_them_nothing(moving):
    verdict = view_dependence.evidence(look(moving, "reflection"))
    assert verdict.statistic == 0.0 and verdict.told and "mirrors" in verdict.reason


def test_a_pattern_without_which_nothing_is_lost_is_absent(moving, monkeypatch):
    monkeypatch.setattr(vignetting, "falloff", lambda fit, none: (0.0, 0.0))
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 1.5)
    sized(monkeypatch, fixed_pattern=1.0)
    seen = look(moving)
    seen.for_patterns.compared = lambda more, less: HeldOut(db=0.5, sigmas=9.0, images=FRAMES)
    assert not fixed_pattern.evidence(seen).told  # a small gain may be an error of what else is fitted
    seen.for_patterns.idle = lambda name, more, less: True
    assert fixed_pattern.evidence(seen).told and fixed_pattern.evidence(seen).statistic == 0.0


@pytest.mark.parametrize("beside, told", [("view_dependence", False), ("frame_offset", True)])
def test_a_pattern_is_certain_only_if_it_gains_much_without_what_may_not_be_there(moving, monkeypatch, beside, told):
    """But what images change by something has to explain, if it be another thing."""
    monkeypatch.setattr(vignetting, "falloff", lambda fit, none: (0.0, 0.0))
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 3.0)
    sized(monkeypatch, fixed_pattern=1.0)
    seen = look(moving, beside)
    found = seen.for_patterns
    found.compared = lambda more, less: HeldOut(db=1.1 if less.names else 0.9, sigmas=9.0, images=FRAMES)
    assert fixed_pattern.evidence(seen).told
    found.doubts = {beside: "nobody can tell"}
    assert fixed_pattern.evidence(seen).told == told


def test_a_curve_is_in_doubt_only_if_it_explains_what_it_was_not_fitted_to():
    offsets = 0.1 * drawn(FRAMES, seed=7)
    straight, bent = fit_to(levels() + offsets), fit_to(levels() + offsets * (1.0 + 3.0 * (levels() - 0.5)))
    assert tone._may_bend(Certainty(bent.accepted(Model.of(frame_offset=1)), Model()))
    assert not tone._may_bend(Certainty(straight.accepted(Model.of(frame_offset=1)), Model()))


@pytest.mark.parametrize("stretch, bend, bent", [(0.0, 10.0, True), (0.0, 0.0, False), (3.0, 0.0, False)])
def test_where_heat_is_in_doubt_a_curve_is_asked_for_beside_a_camera_in_its_place(stretch, bend, bent):
    """Heat takes the offsets along, and what a curve makes of them; gains of the images are no curve."""
    offsets, over = 0.3 * torch.exp(-3.0 * PASSED), levels() - 0.5
    fit = fit_to(levels() + offsets * (1.0 + stretch * over + bend * over**2)).accepted(CHANGING)
    assert not tone._may_bend(Certainty(fit, CHANGING))
    assert tone._may_bend(Certainty(fit, CHANGING, {"relaxation": "a camera explains it as well"})) == bent


@pytest.mark.parametrize("db, sigmas, doubted", [(0.5, 3.0, True), (-0.5, -3.0, False), (0.05, 3.0, False)])
def test_a_curve_that_gains_nothing_where_left_out_is_absent_with_offsets_or_without(monkeypatch, db, sigmas, doubted):
    fit = fit_to(levels() + DRIFT)
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 1.5)
    sized(monkeypatch, tone=1.0)
    monkeypatch.setattr(tone.Certainty, "compared", lambda self, more, less: HeldOut(db, sigmas, FRAMES))
    assert tone._may_bend(SimpleNamespace(fit=fit, model=Model(), doubts={})) == doubted


def test_gains_beside_a_bent_curve_make_up_for_it_and_else_take_the_offsets_along(moving, monkeypatch):
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 5.0)
    seen = look(moving, "agc", "frame_offset", "tone")
    for size, stretched in ((1.0, False), (3.0, True)):
        sized(monkeypatch, agc=size, frame_offset=2.0, tone=2.0)
        assert (agc.evidence(seen).statistic > 1.3) == stretched
        assert (frame_offset.evidence(seen).statistic > 1.3) == (not stretched)
    assert frame_offset.evidence(look(moving, "frame_offset")).statistic == 5.0


@pytest.mark.parametrize(
    "share, gain, fades", [(-0.1, 5.0, True), (-0.03, 5.0, False), (-0.1, 1.0, False), (0.1, 5.0, False)]
)
def test_a_falloff_darkens_corners_and_takes_the_radial_part_of_the_pattern(moving, monkeypatch, share, gain, fades):
    monkeypatch.setattr(vignetting, "falloff", lambda fit, none: (share, gain))
    sized(monkeypatch, vignetting=1.0, fixed_pattern=1.0)
    asked = []
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: (asked.append((more.names, less.names)), 5.0)[1])
    assert (vignetting.evidence(look(moving)).statistic > 1.3) == fades
    assert fixed_pattern.evidence(look(moving)).statistic == 5.0
    radial = {"vignetting"} if fades else set()
    assert set(asked) == {(frozenset(radial | {"fixed_pattern"}), frozenset(radial))}


@pytest.mark.parametrize(
    "share, gain, size, told",
    [
        (0.05, 0.2, 0.05, True),
        (0.05, 0.2, 0.2, False),  # something goes with the distance from the middle, and is no falloff
        (-0.2, 5.0, 0.2, True),  # it is one
        (-0.2, 0.2, 0.2, False),
        (0.4, 0.2, 0.05, False),  # unlikely large
        (-0.4, 0.2, 0.05, False),
    ],
)
def test_under_the_sky_what_is_no_clear_falloff_may_hide_one(monkeypatch, share, gain, size, told):
    monkeypatch.setattr(vignetting, "falloff", lambda fit, none: (share, gain))
    sized(monkeypatch, vignetting=size, **{ANY: 1.0})
    monkeypatch.setattr(Certainty, "worth", lambda *_: Worth(HeldOut(db=3.0, sigmas=9.0, images=FRAMES)))
    fit = fit_to(levels(), drivers=torch.sin(5 * PASSED)[:, None])
    verdict = vignetting.evidence(SimpleNamespace(joint=(fit, Model()), for_patterns=Certainty(fit, Model())))
    assert verdict.told == told and (told and verdict.statistic > 1.3) == (told and share < 0)


def test_a_falloff_is_measured():
    share, gain = vignetting.falloff(fit_to(levels() * FALLOFF), Model())
    assert share == pytest.approx(-0.3, abs=0.06) and gain > 1.3


def test_what_is_not_taken_in_says_why(still, moving):
    assert gained(look(moving), "tone", "").reason.endswith("no offset moves the levels along a curve")
    assert gained(look(still), "vignetting", "").reason.endswith("points are seen from one side only")
    assert gained(look(moving), "agc", "").statistic < 1.3


# Least squares ----------------------------------------------------------------------------------------------


def test_eliminating_points_gives_what_one_dense_system_gives():
    points, frames = 5, 8
    basis, columns = drawn(points, frames, 2), drawn(points, frames, 3, seed=1)
    values, weights = drawn(points, frames, seed=2), drawn(points, frames, seed=3).abs()
    dense = torch.zeros(points * frames, 2 * points + 3, dtype=torch.float64)
    for p in range(points):
        dense[p * frames : (p + 1) * frames, 2 * p : 2 * p + 2] = basis[p]
    dense[:, 2 * points :] = columns.flatten(0, 1)
    root = weights.flatten().sqrt()[:, None]
    expected = torch.linalg.lstsq(root * dense, root * values.flatten()[:, None]).solution[:, 0]
    both = Columns.dense(torch.cat([values[..., None], columns], 2))
    products = least_squares.gram(basis, both, weights)
    shared = least_squares.shared_weights(products)
    assert torch.allclose(shared, expected[2 * points :], atol=1e-6)
    own = least_squares.own_weights(basis, values - columns @ shared, weights)
    assert torch.allclose(own.flatten(), expected[: 2 * points], atol=1e-6)
