"""A detector that lags and is read row by row, against a camera that is integrated in time; recovery of both numbers."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.integrate import solve_ivp
from swinging import HEIGHT, HZ, TIMES, WIDTH, K, frames, pose, recorded, wall

from heatsplat.contracts import Frame, SceneData, SceneError, ViewSet
from heatsplat.geometry.motion import screen_velocity, twists
from heatsplat.geometry.projection import to_camera, to_pixels
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.sensors.rolling_readout import RollingReadout
from heatsplat.sensors.thermal_lag import ThermalLag, moments


def scene(found=None):
    views = ViewSet(found or frames(), lambda index: None)
    return SceneData("wall", views, views, views, torch.zeros(4, 3))


def ready(part, **raw):
    part = part.double()
    part.prepare(scene())
    with torch.no_grad():
        for name, value in raw.items():
            getattr(part, name).fill_(value)
    return part


def lag(tau=0.0, lead=0.0, **options):
    return ready(ThermalLag(**options), raw_tau=math.atanh(tau / 0.05), raw_lead=math.atanh(lead / 0.05))


def rolling(readout=0.0):
    return ready(RollingReadout(), raw_readout=math.atanh(readout / 0.05))


def through(chain, i, image=None):
    image, depth = (wall(TIMES[i].item())[0] if image is None else image), wall(TIMES[i].item())[1]
    return chain(image[..., None], frames()[i], depth)[..., 0]


def test_the_simulated_camera_solves_the_heat_balance_of_its_pixels():
    tau, readout, (row, column) = 0.012, 0.02, (2, 6)
    read = recorded(tau, readout)[3, row, column].item()
    due = TIMES[3].item() + ((row + 0.5) / HEIGHT - 0.5) * readout
    seen = lambda t: wall(t)[0][row, column].item()  # noqa: E731
    start = due - 20 * tau
    solved = solve_ivp(lambda t, y: (seen(t) - y) / tau, (start, due), [seen(start)], rtol=1e-9, atol=1e-12)
    assert read == pytest.approx(solved.y[0, -1], abs=1e-4)
    assert abs(read - seen(TIMES[3].item())) > 0.02


def test_velocities_are_those_of_points_in_the_image():
    dt, at = 1e-4, 0.07
    found = twists(torch.stack([pose(at - dt), pose(at), pose(at + 2 * dt)]), torch.tensor([-dt, 0.0, 2 * dt]))
    points = torch.tensor([[0.3, -0.2, 0.0], [-0.5, 0.4, 0.7], [0.0, 0.1, 30.0]], dtype=torch.float64)
    local = to_camera(points, pose(at))
    velocity = screen_velocity(to_pixels(local, K), 1 / local[:, 2], K, found[1])
    ends = [to_pixels(to_camera(points, pose(at + s * dt)), K) for s in (-1, 1)]
    assert torch.allclose(velocity, (ends[1] - ends[0]) / (2 * dt), rtol=1e-4, atol=1e-4)
    assert not twists(torch.stack([pose(0.0), pose(0.1)]), torch.tensor([5.0, 5.0])).any()  # two frames of one moment


@pytest.mark.parametrize(("tau", "readout", "share"), [(0.012, 0.0, 0.1), (0.0, 0.02, 0.2), (0.012, 0.02, 0.15)])
def test_both_parts_make_of_a_clean_image_what_the_camera_records(tau, readout, share):
    chain, read = SensorChain({"lag": lag(tau), "rolling": rolling(readout)}), recorded(tau, readout)
    inner = (slice(6, -6), slice(6, -6))  # what came in from beyond the border is not in the clean image
    # What is left is of second order, and of reading between pixels.
    error = torch.stack([(through(chain, i) - read[i])[inner] for i in (1, 2, 3, 4)])
    before = torch.stack([(wall(TIMES[i].item())[0] - read[i])[inner] for i in (1, 2, 3, 4)])
    assert error.square().mean().sqrt() < share * before.square().mean().sqrt()
    assert before.square().mean().sqrt() > 0.007


def test_both_numbers_are_found():
    read = recorded(0.012, 0.02)
    chain = SensorChain({"lag": lag(), "rolling": rolling()})
    optimizer = torch.optim.Adam(chain.parameters(), lr=0.04)
    for step in range(40):
        i = 1 + step % 4
        optimizer.zero_grad()
        ((through(chain, i) - read[i])[6:-6, 6:-6].square().mean() + sum(chain.regularisers().values())).backward()
        optimizer.step()
    told = chain.effects()
    assert told["thermal_lag"]["tau_ms"] - told["thermal_lag"]["poses_ahead_ms"] == pytest.approx(12, abs=0.6)
    assert told["rolling_readout"]["readout_ms"] == pytest.approx(20, abs=1.5)


def test_ages_and_weights_integrate_lines_exactly():
    for count in (2, 4, 33):
        ages, weights = moments(count)
        assert weights.min() >= 0 and weights.sum().item() == pytest.approx(1, abs=1e-14)
        assert (weights * ages).sum().item() == pytest.approx(1 - math.exp(-6.0), abs=1e-12)


def test_new_parts_are_the_identity_and_can_leave_it():
    chain = SensorChain({"lag": lag(), "rolling": rolling()})
    image = wall(TIMES[2].item())[0]
    made = through(chain, 2)
    assert torch.allclose(made, image, rtol=0, atol=1e-9)
    (made - recorded(0.012, 0.02)[2]).square().sum().backward()
    assert chain.parts["lag"].raw_tau.grad < -1e-3  # a descent makes it lag
    assert chain.parts["rolling"].raw_readout.grad.abs() > 1e-3
    assert chain.needs_depth and not SensorChain({"offset": FrameOffset()}).needs_depth


def test_gradients_are_those_of_finite_differences():
    image = wall(0.05)[0][:, :, None].clone().requires_grad_()
    parts = {"lag": lag(0.011, 0.003), "rolling": rolling(0.015)}
    raw = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.2, 0.1, 0.3))

    def made(image, tau, lead, readout):
        depth, frame = wall(0.05)[1], frames()[2]
        one = torch.func.functional_call(parts["lag"], {"raw_tau": tau, "raw_lead": lead}, (image, frame, depth))
        return torch.func.functional_call(parts["rolling"], {"raw_readout": readout}, (one, frame, depth)).mean((0, 2))

    assert torch.autograd.gradcheck(made, (image, *raw), eps=1e-7, atol=1e-5, fast_mode=True)


def test_frames_without_times_and_bounds_of_nothing_are_refused():
    timeless = scene([replace(frame, time_s=None) for frame in frames()])
    with pytest.raises(SceneError, match="training views without a time, so nothing is known of how fast"):
        RollingReadout().prepare(timeless)
    with pytest.raises(ValueError, match="tau_max must be positive"):
        ThermalLag(tau_max=0)
    with pytest.raises(ValueError, match="readout_max is a time in seconds"):
        RollingReadout(readout_max=0)


def test_an_image_in_between_moves_as_its_neighbours_and_without_a_lead_there_is_none():
    part = lag(0.012)
    between = Frame("new", 99, frames()[2].camera, 2.5 / HZ)
    middle = part.velocity(between, torch.full((HEIGHT, WIDTH), 2.0))
    ends = [part.at(part.twists, frame) for frame in frames()[2:4]]
    assert torch.allclose(part.at(part.twists, between), sum(ends) / 2) and bool(middle.isfinite().all())
    assert [name for name, _ in ThermalLag(lead_max=0).named_parameters()] == ["raw_tau"]
