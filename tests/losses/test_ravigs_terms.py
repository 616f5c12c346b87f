"""The loss terms of RaViGS against their printed equations, pixel by pixel; masks; what is absent."""

import itertools

import pytest
import torch

from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.losses.compose import Loss, LossInputs, LossTerm, Weighted
from heatsplat.losses.gradients import GradientConsistency, GuidedVariation, guided_variation, slopes
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.physical_prior import PhysicalPrior, kirchhoff_excess, outside

HEIGHT, WIDTH = 9, 7


def image(channels, seed):
    return torch.rand(HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def inputs(mask=None, splats=None, **changes):
    images = {"prediction": image(1, 0), "target": image(1, 1), "rgb": (image(3, 2), image(3, 3))} | changes
    return LossInputs(
        images["prediction"], images["target"], mask, None, splats or {}, companions={"rgb": images["rgb"]}
    )


def pairs():
    """Pixels and their right and lower neighbours, where there are any."""
    for y, x in itertools.product(range(HEIGHT), range(WIDTH)):
        yield (y, x), (y, x + 1) if x + 1 < WIDTH else None, (y + 1, x) if y + 1 < HEIGHT else None


def slope(values, here, there):
    return 0.0 if there is None else (values[there] - values[here]).abs().mean().item()


def test_gradient_consistency_is_equation_13():
    given = inputs()
    difference = given.pair("rgb")[0] - given.pair("rgb")[1]
    expected = sum(slope(difference, here, right) + slope(difference, here, low) for here, right, low in pairs())
    found = GradientConsistency("rgb")(given)
    assert found.item() == pytest.approx(0.5 * expected / (HEIGHT * WIDTH))
    level = inputs(rgb=(image(3, 3) + 0.2, image(3, 3)))
    assert GradientConsistency("rgb")(level).item() == pytest.approx(0.0, abs=1e-12)  # a level is no edge


def test_guided_variation_is_equation_16():
    given, beta, expected = inputs(), 4.0, 0.0
    for here, right, low in pairs():
        edge = slope(given.pair("rgb")[1], here, right) + slope(given.pair("rgb")[1], here, low)
        own = slope(given.prediction, here, right) + slope(given.prediction, here, low)
        expected += own * torch.tensor(-beta * edge).exp().item()
    assert GuidedVariation("rgb", beta)(given).item() == pytest.approx(expected / (HEIGHT * WIDTH), rel=1e-5)


def test_edges_are_free_where_the_guide_has_one():
    step = torch.zeros(4, 6, 1)
    step[:, 3:] = 1.0
    there, elsewhere = step.expand(-1, -1, 3), step.roll(1, 1).expand(-1, -1, 3)
    assert guided_variation(step, there, 10.0).sum() < 1e-3 * guided_variation(step, elsewhere, 10.0).sum()
    assert guided_variation(step, there, 0.0).sum() == 4.0


def test_slopes_end_at_the_border():
    right, down = slopes(torch.arange(6.0).reshape(2, 3, 1))
    assert right[..., 0].tolist() == [[1, 1, 0], [1, 1, 0]] and down[..., 0].tolist() == [[3, 3, 3], [0, 0, 0]]


@pytest.mark.parametrize("term", [GradientConsistency("rgb"), GradientConsistency(), GuidedVariation("rgb")])
def test_masked_pixels_neither_count_nor_learn(term):
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:4] = False
    clean = inputs(mask)
    images = {"prediction": clean.prediction.clone(), "target": clean.target.clone()}
    rgb = [part.clone() for part in clean.pair("rgb")]
    for part in (*images.values(), *rgb):
        part[:4] = torch.nan
    images["prediction"].requires_grad_(), rgb[0].requires_grad_()
    found = term(inputs(mask, **images, rgb=tuple(rgb)))
    assert found.item() == pytest.approx(term(clean).item()) and found > 0
    found.backward()
    for part in (images["prediction"], rgb[0]):
        assert part.grad is None or part.grad.isfinite().all() and part.grad[:4].abs().max() == 0
    assert term(inputs(torch.zeros_like(mask))).item() == 0.0


def test_the_smoothed_image_learns_and_the_guide_does_not():
    prediction, guide = image(1, 0).requires_grad_(), image(3, 3).requires_grad_()
    GuidedVariation("rgb")(inputs(prediction=prediction, rgb=(guide, image(3, 3)))).backward()
    assert prediction.grad.abs().max() > 0 and guide.grad is None


def test_photometric_of_a_companion():
    own = Photometric(0.2)(LossInputs(*inputs().pair("rgb"), None, None, None))
    assert Photometric(0.2, modality="rgb")(inputs()) == own
    with pytest.raises(ValueError, match="asks for depth images, which the model does not explain"):
        Photometric(modality="depth")(inputs())


# The physical prior -----------------------------------------------------------------------------------


def bodies(emissivity, reflectance):
    tensors = {"emissivity": emissivity, "reflectance": reflectance}
    return {
        name: torch.tensor(values, dtype=torch.float64).reshape(-1, 1, 1).requires_grad_()
        for name, values in tensors.items()
    }


def test_bounds_and_excess():
    assert outside(torch.tensor([-0.5, 0.0, 0.7, 1.0, 1.2])).tolist() == pytest.approx([0.5, 0, 0, 0, 0.2])
    assert kirchhoff_excess(torch.tensor(0.9), torch.tensor(0.1), 0.05) == 0
    assert kirchhoff_excess(torch.tensor(0.9), torch.tensor(0.3), 0.05).item() == pytest.approx(0.15)


def test_prior_of_what_acts_and_of_coefficients():
    splats = bodies([8.0, -2.0, 0.5], [1.0, 3.0, 0.5])
    shares = [torch.sigmoid(C0 * splats[name].detach()).flatten() for name in ("emissivity", "reflectance")]
    expected = (shares[0] + shares[1] - 1.05).clamp(min=0).square().mean()
    assert PhysicalPrior(reduction="mean")(inputs(splats=splats)).item() == pytest.approx(expected.item())
    assert PhysicalPrior()(inputs(splats=splats)).item() == pytest.approx(3 * expected.item()) and expected > 0
    printed = PhysicalPrior(of="coefficients", reduction="mean")(inputs(splats=splats))
    # ε⁰: 8 is 7 above 1, -2 is 2 below 0; ρ⁰: 3 is 2 above 1; sums 9, 1 and 1 exceed 1.05 once.
    assert printed.item() == pytest.approx((7**2 + 2**2 + 2**2 + 7.95**2) / 3)
    printed.backward()
    assert splats["emissivity"].grad[2] == 0 and splats["emissivity"].grad[0] > 0 > splats["emissivity"].grad[1]


def test_the_prior_pulls_on_one_as_hard_among_many():
    pulls = []
    for count in (1, 1000):
        splats = bodies([8.0] + [0.0] * (count - 1), [6.0] + [0.0] * (count - 1))
        PhysicalPrior()(inputs(splats=splats)).backward()
        pulls.append(splats["emissivity"].grad[0].item())
    assert pulls[0] == pytest.approx(pulls[1]) and pulls[0] > 0


def test_without_both_attributes_there_is_no_prior():
    assert PhysicalPrior()(inputs(splats={"emissivity": torch.zeros(3, 1, 1)})) == {}
    assert Loss({"prior": Weighted(PhysicalPrior(), 0.01)})(inputs()) == {}
    with pytest.raises(ValueError, match="of must be one of activated, coefficients, got 'raw'"):
        PhysicalPrior(of="raw")
    with pytest.raises(ValueError, match="reduction must be one of sum, mean, got 'max'"):
        PhysicalPrior(reduction="max")


def test_weight_zero_is_absent():
    class Forbidden(LossTerm):
        def __call__(self, given):
            raise AssertionError("a term of weight zero was evaluated")

    assert Loss({"gradient": Weighted(Forbidden(), 0.0), "guided_variation": None})(inputs()) == {}


@pytest.mark.parametrize("make", [lambda: GuidedVariation("rgb", beta=-1.0), lambda: PhysicalPrior(tolerance=-1.0)])
def test_what_may_not_be_negative_is_refused(make):
    with pytest.raises(ValueError, match=r"(beta|tolerance) must not be negative, got -1\.0"):
        make()
