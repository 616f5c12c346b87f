"""The settings of a run's renderer: what lies behind the splats, and what a wrong setting says."""

from dataclasses import replace

import pytest
import torch
from weathered import make_scene

from heatsplat.contracts import RenderOutput, ThermalRange
from heatsplat.renderers import settings
from heatsplat.renderers.settings import Renderer

SCENE = replace(make_scene(), thermal_range=ThermalRange(10.0, 60.0), ambient_c=25.0)


@pytest.mark.parametrize(
    ("background", "modality", "changes", "expected"),
    [
        ("ambient", "thermal", {}, 0.3),
        ("ambient", "thermal", {"ambient_c": 5.0}, 0.0),
        ("ambient", "thermal", {"ambient_c": 99.0}, 1.0),
        ("ambient", "thermal", {"ambient_c": None}, 0.0),
        ("ambient", "thermal", {"thermal_range": None}, 0.0),
        ("ambient", "rgb", {}, 0.0),
        (0.7, "thermal", {}, 0.7),
        (0.7, "rgb", {}, 0.7),
    ],
)
def test_behind_the_splats_lies_the_ambient_temperature(background, modality, changes, expected):
    assert Renderer(background=background).background_of(replace(SCENE, **changes), modality) == pytest.approx(expected)


def test_a_pixel_without_splats_shows_the_background():
    camera = SCENE.train.frames[0].camera
    count = 3
    seen = Renderer(backend="reference")(
        torch.zeros(count, 3), torch.ones(count, 4), torch.ones(count, 3), torch.zeros(1, count), torch.ones(count, 1),
        camera, torch.tensor([0.3]), (1,),
    )  # fmt: skip
    assert torch.equal(seen.features, torch.full_like(seen.features, 0.3)) and not seen.alpha.any()


def test_every_setting_reaches_the_rasteriser(monkeypatch):
    given = {}

    def rasterization(*arguments, **named):
        given.update(named)
        return RenderOutput(torch.zeros(8, 8, 1), torch.zeros(1, 8, 8), None, {})

    monkeypatch.setattr(settings, "rasterization", rasterization)
    own = {"backend": "reference", "antialiased": True, "near": 0.3, "far": 40.0, "eps2d": 0.17}
    rows = torch.zeros(3, 3), torch.ones(3, 4), torch.ones(3, 3), torch.zeros(1, 3), torch.ones(3, 1)
    further = {"absgrad": True, "depth": True, "maps": 2, "signs": torch.ones(8, 8, 2), "raw": True}
    Renderer(**own)(*rows, SCENE.train.frames[0].camera, torch.tensor([0.3]), (1,), **further)
    assert given.pop("background") == torch.tensor([0.3])
    assert given == own | {"modality_channels": (1,)} | further


def test_values_are_seen_before_black_whatever_lies_behind_images():
    camera = SCENE.train.frames[0].camera
    shapes = torch.zeros(3, 3), torch.ones(3, 4), torch.ones(3, 3), torch.zeros(1, 3)
    seen = Renderer(backend="reference", background=0.7).values_seen(shapes, torch.ones(3, 5), camera, depth=True)
    assert seen.features.shape == (camera.height, camera.width, 5) and not seen.features.any()
    assert seen.depth is not None and seen.alpha.shape[0] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "opengl"}, "renderer.backend must be one of auto, .*, got 'opengl'"),
        ({"background": "black"}, "renderer.background must be 'ambient' or a number"),
        ({"background": 1.2}, r"renderer.background must be 'ambient' or a number in \[0, 1\], got '1.2'"),
        ({"background": float("nan")}, "renderer.background must be 'ambient' or a number"),
        ({"background": True}, "renderer.background must be 'ambient' or a number"),
        ({"eps2d": 0.0}, "renderer.eps2d must be above 0"),
        ({"eps2d": float("inf")}, "renderer.eps2d must be above 0 .* and finite"),
        ({"near": -1.0}, "renderer.near must be 0 or more"),
        ({"near": 2.0, "far": 1.0}, "renderer.far beyond it, got 2.0 and 1.0"),
    ],
)
def test_wrong_settings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Renderer(**options)
