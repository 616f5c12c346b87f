"""A focal length that fits neither poses nor points is found, before scenes that change too, and the true one is not."""

from dataclasses import replace

import pytest
from materials import checks, clean

from heatsplat.contracts import Camera
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import material_of
from heatsplat.doctor.checks import focal
from heatsplat.doctor.checks.focal import find, fitting_factor


def wrong(material, factor):
    """The recording with cameras of another focal length."""

    def lens(camera):
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= factor
        return Camera(camera.viewmat, K, camera.width, camera.height)

    return replace(material, cameras=[lens(camera) for camera in material.cameras])


@pytest.mark.parametrize(("scene", "factor"), [("static", 0.9), ("cooling", 1.1)])
def test_a_wrong_focal_length_is_found_and_the_true_one_named(scene, factor):
    bad = wrong(clean(scene), factor)
    assert "focal" in checks(bad, only="focal")
    assert factor * fitting_factor(bad)[0] == pytest.approx(1.0, abs=0.04)
    assert f"of the cameras (in images of {bad.cameras[0].width}x{bad.cameras[0].height})" in find(bad)[0].what
    assert not find(clean(scene))


def test_a_focal_length_is_not_told_by_less_than_a_pixel(monkeypatch):
    small, smaller = (material_of(Synthetic(scene="noisy_sensor", size="tiny", downscale=d).scene) for d in (2.5, 6.4))
    assert not find(smaller) and abs(fitting_factor(smaller)[0] - 1.0) > 0.1  # 10 pixels across
    monkeypatch.setattr(focal, "BETTER", 1.0)
    assert not find(small) and 0.02 < abs(fitting_factor(small)[0] - 1.0) < 2 / 26
    monkeypatch.setattr(focal, "EDGE", 0.0)
    assert find(small) and not find(smaller)
