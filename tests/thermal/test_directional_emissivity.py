"""Emission towards the side of a surface: what closed forms say, and what training learns of it."""

import math
from dataclasses import replace

import mpmath
import pytest
import torch
from torch.nn import functional

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.directional_emissivity import DirectionalEmissivity

BOUNDS, AMBIENT_C = ThermalRange(0.0, 50.0), 20.0


def looking_from(position) -> Camera:
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(position)
    return Camera(viewmat, torch.eye(3), 4, 4)


def scene() -> SceneData:
    views = ViewSet([Frame("0.png", 0, looking_from((0.0, 0.0, 10.0)))], lambda i: None)
    return SceneData("ground", views, views, views, torch.zeros(2, 3), None, BOUNDS, AMBIENT_C)


def splats_of(part: DirectionalEmissivity, normals, dtype=torch.float32) -> Splats:
    count = len(normals)
    seeds = Seeds(torch.zeros(count, 3), torch.zeros(count, 1), torch.Generator())
    declared = {name: item.initial for name, item in part.per_gaussian(seeds).items()}
    tensors = {"log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    tensors |= {"means": torch.zeros(count, 3), "opacity_logits": torch.zeros(count, 1)}
    tensors |= declared | {"normals": torch.tensor(normals)}
    return Splats({name: tensor.to(dtype) for name, tensor in tensors.items()})


def ready(**options) -> DirectionalEmissivity:
    part = DirectionalEmissivity(**options)
    part.prepare(scene())
    return part


def at_angle(degrees: float) -> Camera:
    angle = math.radians(degrees)
    return looking_from((8.0 * math.sin(angle), 0.0, 8.0 * math.cos(angle)))


def shown(part, celsius: float, camera: Camera, normal=(0.0, 0.0, 1.0)) -> float:
    value = torch.tensor([[BOUNDS.to_unit(celsius)]])
    found = part(value, splats_of(part, [normal]), Query(camera=camera))
    return BOUNDS.to_celsius(found).item()


@pytest.mark.parametrize("power", [1, 5])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 85.0])
def test_a_surface_seen_from_its_side_looks_like_the_surroundings(power, degrees):
    lost = 0.6 * (1 - math.cos(math.radians(degrees))) ** power
    part = ready(falloff=0.6, power=power)
    assert shown(part, 45.0, at_angle(degrees)) == pytest.approx(45.0 - lost * 25.0, abs=2e-4)
    assert shown(part, AMBIENT_C, at_angle(degrees)) == pytest.approx(
        AMBIENT_C, abs=1e-5
    )  # nothing is lost without a contrast
    turned = shown(part, 45.0, at_angle(degrees), normal=(0.0, 0.0, -1.0))
    assert turned == shown(part, 45.0, at_angle(degrees))  # a line of sight has no side


def test_a_smooth_dielectric_emits_alike_up_to_half_a_right_angle_and_little_along_itself():
    """Fresnel's equations of an index of 1.5, with Schlick's ρ₀ = 0.04 apart."""

    def emissivity(degrees):
        inside = math.asin(math.sin(math.radians(degrees)) / 1.5)
        i, t = math.cos(math.radians(degrees)), math.cos(inside)
        s, p = ((i - 1.5 * t) / (i + 1.5 * t)) ** 2, ((1.5 * i - t) / (1.5 * i + t)) ** 2
        return (1 - (s + p) / 2) / 0.96

    part = ready(falloff=0.999, power=5)
    splats = splats_of(part, [(0.0, 0.0, 1.0)])
    for degrees in (0.0, 20.0, 45.0, 60.0, 75.0, 85.0):
        found = part.attributes(splats, Query(camera=at_angle(degrees)))["relative_emissivity"].item()
        assert found == pytest.approx(emissivity(degrees), abs=0.04)


def test_extremes_stay_finite_and_near_a_reference_of_fifty_digits():
    part = ready(falloff=0.3, power=5)
    directions = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1e-6), (1e-6, 0.0, 1.0)]
    camera = looking_from((0.0, 0.0, 1e4))
    for value in (-1e6, 0.0, 1e6):
        values = torch.full((4, 1), value)
        found = part(values, splats_of(part, directions), Query(camera=camera))
        with mpmath.workdps(50):
            level = mpmath.mpf(BOUNDS.to_unit(AMBIENT_C))
            for normal, one in zip(directions, found[:, 0].tolist(), strict=True):
                lost = mpmath.mpf(0.3) * (1 - min(abs(mpmath.mpf(normal[2])), 1)) ** 5
                exact = mpmath.mpf(value) + lost * (level - value)
                assert abs(one - exact) <= 3e-7 * max(abs(value), 1)


def test_gradients_are_those_of_finite_differences_and_leave_the_geometry_alone():
    part = ready(falloff=0.4, power=2).double()
    splats = splats_of(part, [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)], torch.float64)
    values = torch.tensor([[0.3], [0.9]], dtype=torch.float64, requires_grad=True)
    query = Query(camera=at_angle(50.0))

    def of(values, logit):
        part.falloff_logit.data = logit
        return part(values, splats, query)

    assert torch.autograd.gradcheck(lambda v: of(v, part.falloff_logit.data), values, atol=1e-8)
    part(values, splats, query).sum().backward()
    eps, logit = 1e-6, part.falloff_logit.data.clone()
    with torch.no_grad():
        slope = (of(values, logit + eps).sum() - of(values, logit - eps).sum()) / (2 * eps)
    assert part.falloff_logit.grad.item() == pytest.approx(slope.item(), rel=1e-6)
    assert splats.means.grad is None


@pytest.mark.parametrize("lr_tilt", [5e-3, 0.0])
def test_heat_refines_normals(lr_tilt):
    """A normal that is 20 degrees off, and views that show it from twelve sides."""
    truth, off = (0.0, 0.0, 1.0), (math.sin(math.radians(20)), 0.0, math.cos(math.radians(20)))
    part = ready(falloff=0.5, power=1, lr_tilt=lr_tilt)
    seen, known = splats_of(part, [off]), splats_of(part, [truth])
    turns = [2 * math.pi * k / 12 for k in range(12)]
    cameras = [looking_from((6 * math.cos(t), 6 * math.sin(t), 4 + 2 * math.sin(3 * t))) for t in turns]
    value = torch.tensor([[0.9]])
    learned = [seen["normal_tilt"]] if lr_tilt else list(part.parameters())
    adam = torch.optim.Adam(learned, 2.5e-2 if lr_tilt else 0.0)
    with torch.no_grad():
        recorded = [part(value, known, Query(camera=one)) for one in cameras]
    for _ in range(60 if lr_tilt else 1):
        adam.zero_grad()
        errors = [part(value, seen, Query(camera=one)) - image for one, image in zip(cameras, recorded, strict=True)]
        torch.cat(errors).square().sum().backward()
        adam.step()
    if not lr_tilt:
        assert "normal_tilt" not in seen and torch.cat(errors).abs().max() > 0.02
        return
    found = functional.normalize(torch.tensor(off) + seen["normal_tilt"][0].detach(), dim=0)
    assert math.degrees(math.acos(min(1.0, float(found @ torch.tensor(truth))))) < 1.0


def test_what_it_tells_changes_with_the_tilt():
    part = ready()
    splats = splats_of(part, [(0.0, 0.0, 1.0)])
    part.attributes(splats, Query(camera=at_angle(60.0)))["relative_emissivity"].sum().backward()
    assert float(splats["normal_tilt"].grad[0, 0]) > 0  # towards the camera


def test_surroundings_of_unknown_temperature_are_learned():
    part = DirectionalEmissivity()
    part.prepare(replace(scene(), ambient_c=None))
    assert {name for name, _ in part.named_parameters()} == {"falloff_logit", "level"}
    assert {name for name, _ in ready().named_parameters()} == {"falloff_logit"}
    assert part.effects() == {"directional_emissivity": {"falloff": pytest.approx(0.3), "power": 5}}


@pytest.mark.parametrize("options", [{"falloff": 0.0}, {"falloff": 1.0}, {"power": 0}, {"power": 1.5}])
def test_what_no_surface_does_is_refused(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        DirectionalEmissivity(**options)


def test_without_a_camera_there_is_no_angle():
    part = ready()
    splats = splats_of(part, [(0.0, 0.0, 1.0)])
    assert part.attributes(splats, Query()) == {}
    with pytest.raises(ValueError, match="give a camera"):
        part(torch.zeros(1, 1), splats, Query())
