"""Heat that flows between neighbours beside a source: contrasts answer it faster than levels do."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional

from heatsplat.effects.heat_source import Source
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.physical.conduction import NEIGHBOURS, evidence
from tests.effects.tracks import FRAMES, NOISE, PASSED, POINTS, TIMES_S, data_of, drawn

RATE, MOMENTS, STEPS = 6.0, 61, 4000
COURSE = ((4.0 * torch.linspace(0, 1, MOMENTS, dtype=torch.float64)) % 2 < 1).double()
DRIVEN = Model.of(relaxation=1, harmonic_source=1)


def lit(flow: float, rates: torch.Tensor) -> torch.Tensor:
    """Excess [P, F] of points at rates [P, 1] per span under a lamp, strong or weak there, with a flow between them."""
    points = drawn(POINTS, 3, seed=4)
    near = torch.cdist(points, points).topk(NEIGHBOURS + 1, largest=False).indices[:, 1:]
    strength, excess = 4.0 * drawn(POINTS, 1, seed=6).exp(), torch.zeros(POINTS, 1, dtype=torch.float64)
    found = [excess]
    for power in functional.interpolate(COURSE[None, None], size=STEPS, mode="linear", align_corners=True).flatten():
        change = strength * power - rates * excess + flow * (excess[near].mean(1) - excess)
        excess = excess + change / STEPS
        found.append(excess)
    return torch.cat(found, 1)[:, (PASSED * STEPS).round().long()]


def seen(values: torch.Tensor, source: Source | None) -> SimpleNamespace:
    fit = fit_of(replace(data_of(values), ambient=0.0))
    tracks = fit.data.tracks
    return SimpleNamespace(
        joint=(fit, DRIVEN),
        obs=SimpleNamespace(times_s=TIMES_S, noise=NOISE, tracks=tracks, ambient=0.0, why=""),
        scene=SimpleNamespace(record=(0.0, float(TIMES_S[-1]))),
        heat_source=source,
    )


KNOWN = Source(1, COURSE, 1.0, 2.0)
ALIKE = torch.full((POINTS, 1), RATE, dtype=torch.float64)


def test_points_that_answer_a_source_by_themselves_do_so_as_fast_as_they_differ_from_their_neighbours():
    found = evidence(seen(lit(0.0, ALIKE), KNOWN))
    assert found.told and found.statistic < 0.5


@pytest.mark.parametrize("flow", [RATE / 2, RATE, 3 * RATE])
def test_a_flow_beside_a_source_is_not_ruled_out(flow):
    found = evidence(seen(lit(flow, ALIKE), KNOWN))
    assert not found.told and "times the rate" in found.reason


@pytest.mark.parametrize("source", [None, Source(1), Source(1, COURSE, 2.0, 1.0)])
def test_a_source_whose_course_nobody_knows_hides_a_flow(source):
    found = evidence(seen(lit(0.0, ALIKE), source))
    assert not found.told and "hides how contrasts fade" in found.reason


def test_contrasts_that_few_neighbours_show_tell_nothing():
    values = lit(0.0, ALIKE).mean(0, keepdim=True).expand(POINTS, FRAMES)
    assert not evidence(seen(values, KNOWN)).told


def settling(flow: float) -> torch.Tensor:
    """Values [P, F] of points that settle at 0.3 from a patch of warmth and spots in it, with a flow between them."""
    points = drawn(POINTS, 3, seed=4)
    near = torch.cdist(points, points).topk(NEIGHBOURS + 1, largest=False).indices[:, 1:]
    excess = 0.3 + 0.15 * points[:, :1] + 0.1 * drawn(POINTS, 1, seed=6)
    found = [excess]
    for _ in range(STEPS):
        excess = excess + (-1.5 * excess + flow * (excess[near].mean(1) - excess)) / STEPS
        found.append(excess)
    return 0.3 + torch.cat(found, 1)[:, (PASSED * STEPS).round().long()]


def among(values: torch.Tensor, ambient: float | None) -> SimpleNamespace:
    """What is seen of points that relax, where the surroundings are said to have this image value."""
    inspected = seen(values, None)
    fit, _ = inspected.joint
    inspected.joint = replace(fit, data=replace(fit.data, ambient=ambient)), Model.of(relaxation=1)
    inspected.obs.ambient, inspected.scene.ambient_c = ambient, 12.0
    return inspected


@pytest.mark.parametrize("ambient, of", [(0.0, r"surroundings by \(12 °C\)"), (None, "nobody knows the surroundings")])
def test_the_reason_says_of_what_levels_fade(ambient, of):
    """Given a temperature that nothing settles at, levels seem to fade less than contrasts: who reads that can tell."""
    assert re.search(of, evidence(among(settling(0.0), ambient)).reason)


def test_where_surfaces_settle_at_the_temperature_of_the_surroundings_a_flow_is_told():
    without, flowing = (evidence(among(settling(flow), 0.3)) for flow in (0.0, 2.0))
    assert without.told and without.statistic < 0.5
    assert flowing.told and flowing.statistic > 2.0


def test_where_surfaces_settle_elsewhere_no_flow_is_told_that_is_none():
    found = evidence(among(settling(0.0), 0.1))
    assert found.statistic > 2.0 and not found.told
    assert "of what they differ from one another by: cannot be told" in found.reason


def test_where_surfaces_settle_elsewhere_a_flow_is_not_ruled_out():
    found = evidence(among(settling(1.0), 0.38))
    assert found.statistic < 0.5 and not found.told
