"""Splitting along the longest semi-axis: the closed form, what it does to an image, and what stays as it was."""

import pytest
import torch

from heatsplat.density.adaptive import Adaptive
from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.renderers.base import rasterization
from heatsplat.splats import Splats

PUBLISHED = LongAxisSplit(offset=1.35, along=0.55, across=0.893, fade=0.6)  # Improved-GS, rho = 0.45


def lone(opacity: float = 0.5) -> Splats:
    """One Gaussian before the camera, longest along a slanted axis in the image."""
    return Splats(
        {
            "means": torch.tensor([[0.1, -0.05, 4.0]]),
            "log_scales": torch.tensor([[0.2, 0.5, 0.3]]).log(),
            "quats": torch.tensor([[0.9, 0.0, 0.0, 0.3]]),
            "opacity_logits": torch.logit(torch.tensor([[opacity]])),
            "heat": torch.tensor([[0.7]]),
        }
    )


def image_of(splats: Splats) -> torch.Tensor:
    K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    shape = [tensor.detach().double() for tensor in (splats.means, splats.quats, splats.scales, splats.opacities)]
    values = splats["heat"].detach().double()
    return rasterization(*shape, values, torch.eye(4).double(), K, 64, 48, backend="reference", depth=False).features


@pytest.mark.parametrize("how", [LongAxisSplit(), PUBLISHED])
def test_closed_form(how: LongAxisSplit):
    splats = lone()
    Cloud(splats).split(torch.tensor([0]), how)
    c, s = (0.9**2 - 0.3**2) / 0.9, 2 * 0.9 * 0.3 / 0.9
    aside = how.offset * 0.5 * torch.tensor([-s, c, 0.0])
    centre = torch.tensor([0.1, -0.05, 4.0])
    torch.testing.assert_close(splats.means.detach(), torch.stack([centre + aside, centre - aside]))
    expected = torch.tensor([0.2 * how.across, 0.5 * how.along, 0.3 * how.across]).repeat(2, 1)
    torch.testing.assert_close(splats.scales.detach(), expected)
    torch.testing.assert_close(splats.opacities.detach(), torch.full((1, 2), 0.5 * how.fade))
    assert splats["heat"].tolist() == [pytest.approx([0.7])] * 2


def test_the_default_keeps_covariance_and_mass():
    how = LongAxisSplit()
    assert how.offset**2 + how.along**2 == pytest.approx(1.0, abs=0.01)
    assert 2 * how.fade * how.along * how.across**2 == pytest.approx(1.0, abs=0.07)


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
def test_image_changes_less_than_with_a_clone_a_random_split_or_the_published_one(opacity: float):
    def change(splats: Splats) -> float:
        return float((image_of(splats) - before).norm() / before.norm())

    before = image_of(lone(opacity))
    split, published, clone = lone(opacity), lone(opacity), lone(opacity)
    Cloud(split).split(torch.tensor([0]), LongAxisSplit())
    Cloud(published).split(torch.tensor([0]), PUBLISHED)
    both = Cloud(clone)
    both.append(both.rows(torch.tensor([0])))
    random = []
    for seed in range(8):
        cloud = Cloud(lone(opacity))
        halves = Adaptive._halves(cloud, torch.tensor([0]), torch.Generator().manual_seed(seed))
        random.append(change(Splats(halves)))
    assert change(split) < 0.2
    assert change(split) < min(change(clone), change(published), *random) / 1.5


def test_moments_and_statistics_of_both_children_are_zero_and_those_of_others_stay():
    generator = torch.Generator().manual_seed(3)
    shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (2,), "heat": (5,)}
    splats = Splats({name: torch.randn(6, *shape, generator=generator) for name, shape in shapes.items()})
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names], lr=0.1)
    sum(splats[name].square().sum() for name in splats.names).backward()
    optimizer.step()
    cloud = Cloud(splats, optimizer, {"seen": torch.ones(6)})
    gone = torch.tensor([False, True, False, False, True, False])
    cloud.drop("heat", gone, {})
    before = {name: optimizer.state[splats[name]]["exp_avg"].clone() for name in splats.names}
    cloud.split(torch.tensor([1, 2]), LongAxisSplit())
    assert len(cloud) == 8 and splats.places("heat").tolist() == [0, -1, 1, 2, -1, 3, -1, 4]
    assert cloud.state["seen"].tolist() == [1, 0, 0, 1, 1, 1, 0, 0]
    for name in shapes:
        moments = optimizer.state[splats[name]]["exp_avg"]
        assert moments.shape == splats[name].shape
        zero = {"heat": [1, 4]}.get(name, [1, 2, 6, 7])
        assert moments.flatten(1).any(1).logical_not().nonzero().flatten().tolist() == zero
        rest = [row for row in range(len(before[name])) if row not in zero]
        assert torch.equal(moments[rest], before[name][rest])


def test_splitting_none_changes_nothing():
    splats = lone()
    Cloud(splats).split(torch.tensor([], dtype=torch.long), LongAxisSplit())
    assert len(splats) == 1


@pytest.mark.parametrize("scales", [[0.5, 0.45, 0.4], [0.4, 0.5, 0.4], [0.3, 0.3, 0.3], [0.5, 0.1, 0.3]])
def test_the_shortest_axis_stays_the_shortest_since_models_take_it_for_the_normal(scales: list[float]):
    splats = lone()
    splats["log_scales"].data[:] = torch.tensor([scales]).log()
    before = splats.scales.argmin(1)
    Cloud(splats).split(torch.tensor([0]), LongAxisSplit())
    assert splats.scales.argmin(1).tolist() == before.tolist() * 2
    assert (splats.scales <= torch.tensor(scales) + 1e-6).all()


@pytest.mark.parametrize(
    "wrong",
    [{"offset": -0.1}, {"along": 0.0}, {"across": float("inf")}, {"fade": 0.0}, {"fade": 1.1}, {"fade": float("nan")}],
)
def test_a_split_that_is_none_is_refused(wrong):
    with pytest.raises(ValueError, match=r"density.split: offset must not be negative, .* fade must lie in"):
        LongAxisSplit(**wrong)


@pytest.mark.parametrize(("logit", "fade"), [(40.0, 1.0), (-90.0, 0.5), (0.3, 1.0)])
def test_opacities_at_their_limits_have_logits(logit, fade):
    splats = lone()
    splats["opacity_logits"].data.fill_(logit)
    Cloud(splats).split(torch.tensor([0]), LongAxisSplit(fade=fade))
    assert splats["opacity_logits"].isfinite().all()
    expected = fade * torch.tensor(logit).sigmoid()
    torch.testing.assert_close(splats.opacities[0, 0], expected, atol=1e-6, rtol=0)
