"""The effect directional_emissivity: its falloff is found, beside haze too, and mirrors and harmonics are not taken for it."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional
from tracks import FRAMES, NOISE, POINTS, data_of, drawn, levels

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects.catalogue import decide
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import given_way, selected, worthwhile
from heatsplat.effects.physical import directional_emissivity
from heatsplat.effects.physical.directional_emissivity import falloff_of, on_surfaces, slant
from heatsplat.geometry.rotations import reflected

NORMALS = functional.normalize(drawn(POINTS, 3, seed=21), dim=1)
AMBIENT = 0.2


def emitting(falloff, power, extinction=0.0, noise=NOISE):
    """Data of surfaces of these levels, seen through air of this extinction."""
    empty = data_of(levels(), noise=0.0, normals=NORMALS)
    share = 1.0 - falloff * slant(empty, power)
    share = share * torch.exp(-extinction * empty.tracks.distances)
    data = data_of(AMBIENT + share * (levels() - AMBIENT), noise=noise, normals=NORMALS)
    return Data(data.effects, data.tracks, data.times_s, AMBIENT, NOISE, NORMALS)


@pytest.mark.parametrize(("falloff", "power"), [(0.4, 1), (0.9, 5), (0.0, 1)])
def test_the_falloff_is_found(falloff, power):
    model = Model.of(directional_emissivity=power)
    fit = fit_of(emitting(falloff, power)).accepted(model)
    assert falloff_of(fit, power, *fit.before_path(model, "directional_emissivity")) == pytest.approx(falloff, abs=0.02)


@pytest.mark.parametrize("power", [1, 5])
def test_what_was_put_in_is_selected_with_its_power(power):
    _, model = selected(fit_of(emitting(0.6, power)))
    assert {name: model.kind(name) for name in model.names} == {"directional_emissivity": power}


def test_beside_haze_both_are_found():
    model = Model.of(directional_emissivity=1, attenuation="constant")
    fit = fit_of(emitting(0.4, 1, extinction=0.1, noise=0.001)).accepted(model)
    assert falloff_of(fit, 1, *fit.before_path(model, "directional_emissivity")) == pytest.approx(0.4, abs=0.02)
    values, basis = fit.own(model)
    known = torch.exp(-0.1 * fit.data.tracks.distances) * (1.0 - 0.4 * slant(fit.data, 1))
    ratio = basis[..., 0] / known
    assert (ratio / ratio.mean() - 1).abs().max() < 0.002
    assert torch.equal(values, fit.data.tracks.values - AMBIENT)  # the surroundings are taken away once


def test_harmonics_of_each_point_give_way_unless_they_explain_much_more():
    harmonics, angle = Model.of(view_dependence=1), Model.of(directional_emissivity=1)
    assert given_way(fit_of(emitting(0.4, 1)), harmonics) == angle
    other = data_of(levels() + 0.3 * (data_of(levels()).tracks.directions * drawn(POINTS, 1, 3, seed=22)).sum(2))
    fit = fit_of(Data(other.effects, other.tracks, other.times_s, AMBIENT, NOISE, NORMALS))
    assert given_way(fit, harmonics) == harmonics
    beside = harmonics.plus("directional_emissivity", 1)
    assert worthwhile(fit, beside, angle, "view_dependence")  # and are taken in beside it


def test_harmonics_that_make_up_for_normals_of_some_points_are_not_taken_in():
    truth = emitting(0.4, 1)
    rough = NORMALS.clone()
    rough[::5] = rough[::5].roll(1, 1)
    fit = fit_of(Data(truth.effects, truth.tracks, truth.times_s, AMBIENT, NOISE, rough))
    angle = Model.of(directional_emissivity=1)
    beside = angle.plus("view_dependence", 1)
    assert fit.effect_size(beside, angle) > 0.5  # though they are large
    assert not worthwhile(fit, beside, angle, "view_dependence")


def test_mirrors_take_the_place_of_harmonics_that_make_up_for_normals_of_some_points():
    x, y, z = reflected(-data_of(levels()).tracks.directions, NORMALS[:, None]).unbind(2)
    rough = NORMALS.clone()
    rough[::5] = rough[::5].roll(1, 1)
    truth = data_of(levels() + 0.2 * x - 0.1 * y * z, normals=rough)
    harmonics = Model.of(view_dependence=1)
    assert given_way(fit_of(truth), harmonics) == Model.of(reflection=1)


def test_what_few_slanted_points_lose_is_no_falloff_of_all():
    angle = Model.of(directional_emissivity=1)
    for dull, told in ((torch.ones(POINTS, 1), True), (torch.arange(POINTS)[:, None] % 10 == 0, False)):
        empty = data_of(levels(), noise=0.0, normals=NORMALS)
        share = 1.0 - 0.4 * dull * slant(empty, 1)
        seen = data_of(AMBIENT + share * (levels() - AMBIENT), noise=0.001, normals=NORMALS)
        fit = fit_of(Data(seen.effects, seen.tracks, seen.times_s, AMBIENT, NOISE, NORMALS)).accepted(angle)
        assert on_surfaces(fit, angle, Model()) == told


def test_what_shared_effects_add_is_no_excess():
    truth = emitting(0.4, 1, noise=0.001)
    values = truth.tracks.values + 0.05 * drawn(FRAMES, seed=23)
    fit = fit_of(replace(truth, tracks=replace(truth.tracks, values=values)))
    model = Model.of(directional_emissivity=1, frame_offset=1)
    for _ in range(3):
        fit = fit.accepted(model)
    assert falloff_of(fit, 1, *fit.before_path(model, "directional_emissivity")) == pytest.approx(0.4, abs=0.015)


def test_without_normals_or_surroundings_nothing_is_tried():
    data = emitting(0.4, 1)
    kinds = directional_emissivity.kinds
    assert tuple(kinds(fit_of(data))) == (1, 5)
    for normals, ambient in ((None, AMBIENT), (NORMALS, None)):
        assert not kinds(fit_of(Data(data.effects, data.tracks, data.times_s, ambient, NOISE, normals)))
    still = data_of(levels(), still=True, normals=NORMALS)
    assert not kinds(fit_of(Data(still.effects, still.tracks, still.times_s, AMBIENT, NOISE, NORMALS)))
    told = directional_emissivity.evidence(SimpleNamespace(obs=SimpleNamespace(ambient=None)))
    assert told.statistic is None and "temperature of the surroundings" in told.reason


def test_a_dull_scene_starts_from_its_own_falloff():
    found = decide(Synthetic(scene="dull", size="tiny").scene)
    assert {name for name, verdict in found.items() if verdict.on} == {"directional_emissivity"}
    verdict = found["directional_emissivity"]
    assert verdict.settings == {"falloff": pytest.approx(0.4, abs=0.03), "power": 1}
    assert verdict.told and verdict.gain_db > 5.0
    assert "emissivity, as far as normals are known" in found["view_dependence"].reason


def test_mirrors_are_none():
    found = decide(Synthetic(scene="mirrors", size="tiny").scene)
    assert {name for name, verdict in found.items() if verdict.on} == {"reflection"}
