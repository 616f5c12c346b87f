"""U-values of walls whose loss of heat is known."""

import pytest
import torch

from heatsplat.physics.walls import OUTSIDE_M2_K_W, u_value


def test_a_wall_in_steady_heat_has_the_u_value_of_its_layers():
    layers = torch.tensor([0.3, 0.7, 3.3])  # m² K/W, with the resistance inside
    indoor, outdoor = 20.0, -5.0
    truth = 1 / (layers + OUTSIDE_M2_K_W)
    loss = truth * (indoor - outdoor)
    surface = outdoor + OUTSIDE_M2_K_W * loss
    assert torch.allclose(u_value(loss, indoor, surface), truth)
    assert torch.allclose(u_value(loss, indoor, surface - 3.0) < truth, torch.tensor(True))  # colder sky, same loss


def test_where_it_is_as_warm_outside_nothing_can_be_told():
    assert u_value(torch.tensor([5.0]), 20.0, torch.tensor([19.5])).isnan().all()
    assert float(u_value(torch.tensor([5.0]), 20.0, torch.tensor([0.0]))) == pytest.approx(5 / 20.2)


def test_what_takes_in_heat_is_no_wall_of_a_heated_room_but_errors_about_a_good_one_stay():
    told = u_value(torch.tensor([-80.0, -2.0, 2.0]), 20.0, torch.tensor([0.0, 0.0, 0.0]))
    assert told[0].isnan() and float(told[1:].mean()) == pytest.approx(0.0, abs=1e-3)
