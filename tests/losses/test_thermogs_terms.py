"""The terms of ThermoGS: edges of images, and what ties temperatures to time, balance and table."""

import pytest
import torch

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.edge_difference import EdgeDifference
from heatsplat.losses.sobel import sobel_magnitude
from heatsplat.thermal import heat_terms
from heatsplat.thermal.land_cover import ATTRIBUTES, CLASSES, TABLE, UNKNOWN, reference


def inputs(prediction, target, mask=None):
    return LossInputs(prediction, target, mask, None, None)


def ramp(slope: float, columns: int = 9) -> torch.Tensor:
    return (slope * torch.arange(columns, dtype=torch.float32)).expand(7, columns)[..., None].contiguous()


def test_the_edge_loss_counts_slopes_per_pixel():
    # Columns at the border see half a slope, as the image is continued by its border: 7 whole and 2 halves of 9.
    assert EdgeDifference()(inputs(ramp(0.05), ramp(0.08))).item() == pytest.approx(0.03 * 8 / 9, rel=1e-5)
    assert EdgeDifference()(inputs(ramp(0.05), ramp(-0.05))).item() == pytest.approx(0.0, abs=1e-7)  # magnitudes


def test_the_edge_loss_of_flat_images_is_zero_with_a_finite_gradient():
    flat = torch.full((6, 6, 1), 0.3, requires_grad=True)
    loss = EdgeDifference()(inputs(flat, torch.full((6, 6, 1), 0.7)))
    loss.backward()
    assert loss.item() == 0.0 and flat.grad.isfinite().all()


def test_masked_pixels_neither_count_nor_pull():
    generator = torch.Generator().manual_seed(0)
    prediction, target = (torch.rand(8, 8, 1, generator=generator) for _ in range(2))
    mask = torch.ones(8, 8, dtype=torch.bool)
    mask[:, :3] = False
    spoilt = torch.where(mask[..., None], target, torch.nan)
    prediction.requires_grad_()
    loss = EdgeDifference()(inputs(prediction, spoilt, mask))
    loss.backward()
    # What counts are the columns whose window holds no masked one: those of the crop without its first column.
    crop = EdgeDifference()(inputs(prediction.detach()[:, 3:], target[:, 3:], None))
    first = (sobel_magnitude(prediction.detach()[:, 3:]) - sobel_magnitude(target[:, 3:])).abs()[:, 0].sum() / 8
    assert loss.item() == pytest.approx((crop.item() * 40 - first.item()) / 32, rel=1e-4)
    assert (prediction.grad[:, :3] == 0).all() and prediction.grad[:, 4:].abs().sum() > 0
    assert EdgeDifference()(inputs(prediction, spoilt, torch.zeros(8, 8, dtype=torch.bool))).item() == 0


def test_a_body_that_follows_its_balance_costs_nothing():
    now, rates = torch.tensor([0.2, 0.6]), torch.tensor([1e-4, -2e-4])
    later = now + 300.0 * rates
    assert heat_terms.integration(now, later, rates, 300.0).item() == pytest.approx(0.0, abs=1e-7)
    assert heat_terms.difference_quotient(now, later, rates, 300.0, 600.0).item() == pytest.approx(0.0, abs=1e-6)
    assert heat_terms.change(now, later).item() == pytest.approx(0.5 * (0.03 + 0.06), rel=1e-5)


def test_terms_are_of_order_one_where_a_balance_asks_for_the_whole_range():
    still, rates = torch.full((4,), 0.5), torch.full((4,), 1 / 600.0)  # the whole range within the longest interval
    assert heat_terms.integration(still, still, rates, 600.0).item() == pytest.approx(1.0)
    for interval in (60.0, 600.0, -600.0):
        assert heat_terms.difference_quotient(still, still, rates, interval, 600.0).item() == pytest.approx(1.0)


def test_materials_are_measured_against_the_table_each_in_its_own_scale():
    rows = reference(torch.tensor([1, 6]))
    body = dict(zip(ATTRIBUTES, rows.unbind(1), strict=True))
    assert heat_terms.to_reference(body, rows).item() == 0.0
    body["convection"] = body["convection"] + 5.0
    assert heat_terms.to_reference(body, rows).item() == pytest.approx(0.5 / 4)
    body["capacity"] = body["capacity"] - 2.5e6
    assert heat_terms.to_reference(body, rows).item() == pytest.approx(1.5 / 4)


def test_bodies_without_a_class_do_not_count():
    rows = reference(torch.tensor([UNKNOWN, 3]))
    assert rows[0].isnan().all()
    raw = torch.full((2,), 0.5, requires_grad=True)
    body = dict(zip(ATTRIBUTES, reference(torch.tensor([3, 3])).unbind(1), strict=True)) | {"emissivity": raw}
    loss = heat_terms.to_reference(body, rows)
    loss.backward()
    assert loss.item() == pytest.approx((TABLE["grassland"][0] - 0.5) / 4, rel=1e-5)
    assert raw.grad[0] == 0 and raw.grad[1] == pytest.approx(-0.25)
    nobody = heat_terms.to_reference(body, reference(torch.tensor([UNKNOWN, UNKNOWN])))
    assert nobody.item() == 0.0


def test_the_table_is_that_of_the_paper():
    assert len(CLASSES) == 10 and CLASSES[0] == "building" and CLASSES[9] == "bare_ground"
    assert reference(torch.tensor(CLASSES.index("water_body"))).tolist() == pytest.approx([0.96, 0.65, 15.0, 4.2e6])
    assert reference(torch.tensor(CLASSES.index("road"))).tolist() == pytest.approx([0.88, 0.88, 8.0, 2.1e6])
