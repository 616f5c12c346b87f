"""The edge loss: flat images, masks, gradients, and the three-way weighting."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.losses.compose import Loss, LossInputs
from heatsplat.losses.edge import Edge, EdgeEnhanced
from heatsplat.losses.photometric import Photometric


def noise(height=12, width=17, channels=1, seed=0, dtype=torch.float32):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def inputs(prediction, target, mask=None):
    return LossInputs(prediction, target, mask, view=None, splats=None)


def test_flat_images_have_no_edges_and_finite_gradients():
    flat = torch.full((6, 7, 1), 0.4, requires_grad=True)
    loss = Edge()(inputs(flat, torch.full((6, 7, 1), 0.9)))
    loss.backward()
    assert loss.item() == pytest.approx(0.0, abs=1e-12)
    assert flat.grad.abs().max() == 0


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-3.0, 3.0),
    st.floats(0.0, 2.0),
    st.integers(0, 1000),
    st.sampled_from([(1, 1), (1, 5), (2, 2), (9, 7)]),
)
def test_loss_and_gradient_are_finite_whatever_the_image(level, contrast, seed, size):
    prediction = (level + contrast * noise(*size, seed=seed)).requires_grad_()
    loss = Edge()(inputs(prediction, noise(*size, seed=seed + 1)))
    loss.backward()
    assert loss.isfinite() and loss >= 0 and prediction.grad.isfinite().all()


def test_gradients_agree_with_differences():
    target = noise(5, 6, 2, seed=1, dtype=torch.float64)
    mask = torch.ones(5, 6, dtype=torch.bool)
    mask[0, 0] = False
    prediction = noise(5, 6, 2, dtype=torch.float64).requires_grad_()
    for valid in (None, mask):
        assert torch.autograd.gradcheck(lambda x, valid=valid: Edge()(inputs(x, target, valid)), (prediction,))


def test_equal_images_cost_nothing_and_a_blurred_edge_does():
    target = torch.zeros(10, 10, 1)
    target[:, 5:] = 1.0
    assert Edge()(inputs(target.clone(), target)) == 0
    blurred = target.clone()
    blurred[:, 4:6] = torch.tensor([1 / 3, 2 / 3])[:, None]
    # Columns 4, 5: |8/2 - ...|: slopes over two pixels are 4 sharp; blurred 8/3 at 4 and 5, 4/3 at 3 and 6.
    expected = 10 * (2 * (4 - 8 / 3) ** 2 + 2 * (4 / 3) ** 2) / 100
    assert Edge()(inputs(blurred, target)).item() == pytest.approx(expected, rel=1e-4)


def test_masked_pixels_neither_count_nor_learn():
    mask = torch.ones(12, 17, dtype=torch.bool)
    mask[4:6, 8] = False
    target, prediction = noise(seed=1), noise(seed=2)
    spoiled_target, spoiled = target.clone(), prediction.clone()
    spoiled_target[4:6, 8], spoiled[4:6, 8] = float("nan"), 100.0
    spoiled.requires_grad_()
    loss = Edge()(inputs(spoiled, spoiled_target, mask))
    loss.backward()
    assert loss.item() == pytest.approx(Edge()(inputs(prediction, target, mask)).item())
    assert spoiled.grad.isfinite().all() and spoiled.grad[4:6, 8].abs().max() == 0


def test_a_full_mask_is_no_mask_and_an_empty_one_is_zero():
    target, prediction = noise(seed=1), noise(seed=2)
    full = torch.ones(12, 17, dtype=torch.bool)
    assert Edge()(inputs(prediction, target, full)).item() == pytest.approx(Edge()(inputs(prediction, target)).item())
    assert Edge()(inputs(prediction, target, ~full)) == 0


@pytest.mark.parametrize("dssim, edge", [(0.2, 0.1), (0.0, 0.3), (0.9, 0.1), (0.5, 0.0)])
def test_the_three_weights_are_those_of_equation_16(dssim, edge):
    target, prediction = noise(seed=1), noise(seed=2)
    got = Loss({"photometric": EdgeEnhanced(dssim, edge)})(inputs(prediction, target))
    plain = Photometric(0.5)(inputs(prediction, target))
    expected = {"l1": (1 - dssim - edge) * 2 * plain["l1"], "dssim": dssim * 2 * plain["dssim"]}
    expected["edge"] = edge * Edge()(inputs(prediction, target))
    names = {name for name, weight in (("l1", 1), ("dssim", dssim), ("edge", edge)) if weight}
    assert set(got) == {f"photometric/{name}" for name in names}
    for name in names:
        assert got[f"photometric/{name}"].item() == pytest.approx(expected[name].item(), rel=1e-5, abs=1e-7)


def test_without_the_edge_term_the_operator_is_not_evaluated():
    term = EdgeEnhanced(edge_weight=0.0)
    term.edge = lambda _: pytest.fail("the edge term was evaluated")
    plain = Photometric(0.2)(inputs(noise(seed=1), noise(seed=2)))
    assert term(inputs(noise(seed=1), noise(seed=2))) == plain


@pytest.mark.parametrize("dssim, edge", [(-0.1, 0.1), (0.2, -0.1), (0.6, 0.5), (0.0, 1.0)])
def test_weights_that_leave_nothing_for_l1(dssim, edge):
    with pytest.raises(ValueError, match="shares of the loss that leave one for the L1 term"):
        EdgeEnhanced(dssim, edge)


def test_images_of_two_sizes():
    with pytest.raises(ValueError, match=r"must have one shape, got \[12, 17, 1\] and \[3, 4, 1\]"):
        Edge()(inputs(noise(), noise(3, 4)))
