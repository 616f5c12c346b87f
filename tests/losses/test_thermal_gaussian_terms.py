"""The loss terms of ThermalGaussian against a loop over pixels, its weights, and terms that count for a while."""

import pytest
import torch

from heatsplat.losses.compose import During, Loss, LossInputs, LossTerm, Weighted
from heatsplat.losses.modality_balance import ByOthersShare
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.smoothness import Smoothness, neighbour_differences
from heatsplat.splats import Splats

HEIGHT, WIDTH = 6, 5


def image(channels, seed):
    return torch.rand(HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def inputs(mask=None, step=0, splats=None, **changes):
    images = {"prediction": image(1, 0), "target": image(1, 1), "rgb": (image(3, 2), image(3, 3))} | changes
    return LossInputs(
        images["prediction"], images["target"], mask, None, splats, step, step / 10, {"rgb": images["rgb"]}
    )


def neighbours(y, x):
    around = ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1))
    return [(v, u) for v, u in around if 0 <= v < HEIGHT and 0 <= u < WIDTH]


@pytest.mark.parametrize("masked", [False, True])
def test_smoothness_and_its_gradient_are_those_of_a_loop(masked):
    values = image(2, 4)
    mask = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(9)) > 0.3 if masked else None
    counts = torch.ones(HEIGHT, WIDTH, dtype=torch.bool) if mask is None else mask
    total, slope = 0.0, torch.zeros_like(values)
    for y, x in counts.nonzero().tolist():
        for there in neighbours(y, x):
            if counts[there]:
                difference = values[y, x] - values[there]
                total += difference.abs().sum().item()
                slope[y, x] += difference.sign()  # of the pixel alone: its neighbours stand still
    number = counts.sum().item() * 2
    given = values.clone()
    if masked:
        given[~mask] = torch.nan
    given.requires_grad_()
    found = Smoothness("rgb")(inputs(mask, rgb=(given, given.detach())))
    found.backward()
    assert found.item() == pytest.approx(total / number, rel=1e-12)
    assert torch.allclose(given.grad, slope / number, atol=1e-14)


def test_smoothness_of_little_or_nothing_is_zero():
    assert neighbour_differences(torch.rand(1, 1, 3)).sum() == 0
    assert neighbour_differences(torch.full((4, 3, 1), 0.7)).sum() == 0
    assert Smoothness()(inputs(torch.zeros(HEIGHT, WIDTH, dtype=torch.bool))).item() == 0


def cloud(thermal, rgb):
    """Gaussians of which the first belong to the thermal image and the others to the colour one."""
    logits = torch.tensor([[0.3, -30.0]] * thermal + [[-30.0, -5.0]] * rgb)
    rows = len(logits)
    return Splats(
        {"means": torch.zeros(rows, 3), "log_scales": torch.zeros(rows, 3), "quats": torch.ones(rows, 4)}
        | {"opacity_logits": logits}
    )


def test_the_image_with_more_gaussians_weighs_less():
    given = inputs(splats=cloud(30, 10))
    terms = {"thermal": ByOthersShare(Photometric(), 0, 0.6), "rgb": ByOthersShare(Photometric(modality="rgb"), 1, 0.3)}
    found = Loss(terms)(given)
    thermal, rgb = Photometric()(given), Photometric(modality="rgb")(given)
    for part in ("l1", "dssim"):
        assert found[f"thermal/{part}"].item() == pytest.approx(0.6 * 10 / 40 * thermal[part].item(), rel=1e-6)
        assert found[f"rgb/{part}"].item() == pytest.approx(0.3 * 30 / 40 * rgb[part].item(), rel=1e-6)


def test_a_share_without_opacities_of_its_own_is_refused():
    single = Splats({"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "quats": torch.ones(2, 4)}
                    | {"opacity_logits": torch.zeros(2, 1)})  # fmt: skip
    with pytest.raises(ValueError, match=r"have opacity 0, but Gaussians have 1; .*thermal.shared_opacity=false"):
        ByOthersShare(Photometric(), 0)(inputs(splats=single))


def test_a_term_counts_during_its_steps_only():
    class Never(LossTerm):
        def __call__(self, inputs):
            raise AssertionError("evaluated")

    terms = {"first": During(Smoothness(), stop=4), "second": During(Weighted(Smoothness("rgb"), 0.5), start=4)}
    assert [list(Loss(terms)(inputs(step=step))) for step in (0, 3, 4, 9)] == [["first"]] * 2 + [["second"]] * 2
    assert During(Never(), start=5)(inputs(step=4)) == {} and During(Never(), stop=5)(inputs(step=5)) == {}
