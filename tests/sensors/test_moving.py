"""Parts before which the image moves, together, against a camera that is integrated in time; recovery of both numbers."""

import math
from dataclasses import replace

import pytest
import torch
from swinging import HEIGHT, HZ, TIMES, WIDTH, film, frames, ready, recorded, through, wall

from heatsplat.contracts import Frame, SceneError
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.sensors.moving import displaced
from heatsplat.sensors.rolling_readout import RollingReadout
from heatsplat.sensors.thermal_lag import ThermalLag


def chained(tau=0.0, readout=0.0):
    lag, rolling = (ready(part()) for part in (ThermalLag, RollingReadout))
    with torch.no_grad():
        lag.raw_tau.fill_(math.atanh(tau / 0.05))
        rolling.raw_readout.fill_(math.atanh(readout / 0.05))
    return SensorChain({"lag": lag, "rolling": rolling})


@pytest.mark.parametrize(("tau", "readout", "share"), [(0.012, 0.0, 0.1), (0.0, 0.02, 0.2), (0.012, 0.02, 0.15)])
def test_both_parts_make_of_a_clean_image_what_the_camera_records(tau, readout, share):
    chain, read = chained(tau, readout), recorded(tau, readout)
    inner = (slice(6, -6), slice(6, -6))  # what came in from beyond the border is not in the clean image
    # What is left is of second order, and of reading between pixels.
    error = torch.stack([(through(chain, i) - read[i])[inner] for i in (1, 2, 3, 4)])
    before = torch.stack([(wall(TIMES[i].item())[0] - read[i])[inner] for i in (1, 2, 3, 4)])
    assert error.square().mean().sqrt() < share * before.square().mean().sqrt()
    assert before.square().mean().sqrt() > 0.007


def test_both_numbers_are_found():
    read = recorded(0.012, 0.02)
    chain = chained()
    optimizer = torch.optim.Adam(chain.parameters(), lr=0.04)
    for step in range(40):
        i = 1 + step % 4
        optimizer.zero_grad()
        ((through(chain, i) - read[i])[6:-6, 6:-6].square().mean() + sum(chain.regularisers().values())).backward()
        optimizer.step()
    told = chain.effects()
    assert told["thermal_lag"]["tau_ms"] - told["thermal_lag"]["poses_ahead_ms"] == pytest.approx(12, abs=0.6)
    assert told["rolling_readout"]["readout_ms"] == pytest.approx(20, abs=1.5)


def test_new_parts_are_the_identity_and_can_leave_it():
    chain = chained()
    image = wall(TIMES[2].item())[0]
    made = through(chain, 2)
    assert torch.allclose(made, image, rtol=0, atol=1e-9)
    (made - recorded(0.012, 0.02)[2]).square().sum().backward()
    assert chain.parts["lag"].raw_tau.grad < -1e-3  # a descent makes it lag
    assert chain.parts["rolling"].raw_readout.grad.abs() > 1e-3
    assert chain.needs_depth and not SensorChain({"offset": FrameOffset()}).needs_depth


def test_an_image_is_looked_up_so_many_pixels_away_and_beyond_the_border_lies_the_border():
    image = torch.rand(5, 7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offsets = torch.zeros(2, 5, 7, 2, dtype=torch.float64)
    offsets[0, ..., 0], offsets[1, ..., 1] = 1.0, -0.25
    right, up = displaced(image, offsets)
    assert torch.allclose(right[:, :-1], image[:, 1:]) and torch.allclose(right[:, -1], image[:, -1])
    assert torch.allclose(up[1:], 0.75 * image[1:] + 0.25 * image[:-1]) and torch.allclose(up[0], image[0])


def test_an_image_in_between_moves_as_its_neighbours_do_and_frames_without_times_are_refused():
    part = ready(ThermalLag())
    between = Frame("new", 99, frames()[2].camera, 2.5 / HZ)
    ends = [part.at(part.twists, frame) for frame in frames()[2:4]]
    assert torch.allclose(part.at(part.twists, between), sum(ends) / 2)
    assert part.velocity(between, torch.full((HEIGHT, WIDTH), torch.inf)).isfinite().all()  # nothing is seen
    with pytest.raises(SceneError, match="training views without a time, so nothing is known of how fast"):
        RollingReadout().prepare(film([replace(frame, time_s=None) for frame in frames()]))
