"""The effect thermal_opacity: what few points that lie behind others tell."""

from types import SimpleNamespace

import pytest
import torch

from heatsplat.effects.physical import thermal_opacity


@pytest.mark.parametrize(
    ("points", "apart", "told"), [(0, 0, True), (1, 0, True), (1, 1, False), (2, 0, True), (8, 3, True), (8, 5, False)]
)
def test_few_votes_tell_where_so_few_of_them_differ(monkeypatch, points, apart, told):
    thermal, visible = torch.ones(points), torch.ones(points)
    visible[:apart] = -1
    monkeypatch.setattr(thermal_opacity, "_votes", lambda scene: (thermal, visible))
    seen = SimpleNamespace(scene=None, joint=None, obs=SimpleNamespace(tracks=(), still=False, why=""))
    evidence = thermal_opacity.evidence(seen)
    assert evidence.told is told and evidence.statistic == 0.0


@pytest.mark.parametrize(("warms", "told"), [(False, True), (True, False)])
def test_thermal_images_that_vary_say_nothing_where_points_may_be_lit_or_cool(monkeypatch, warms, told):
    """Two of eight differ; of those whose thermal image shows the nearer point one of three, and that may be many."""
    votes = torch.tensor([1, -1, -1, 1, 1, -1, -1, -1]), torch.tensor([1, 1, -1, 1, -1, -1, -1, -1])
    monkeypatch.setattr(thermal_opacity, "_votes", lambda scene: votes)
    obs = SimpleNamespace(tracks=(), still=False, why="")
    seen = SimpleNamespace(scene=None, joint=(), obs=obs, certainty=SimpleNamespace(may_warm=warms))
    assert thermal_opacity.evidence(seen).told is told
