"""Each check finds what was put in, and nothing where nothing was."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch.nn import functional

from heatsplat.contracts import Camera
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import Material, material_of
from heatsplat.doctor.examination import CHECKS, examine


@cache
def clean(scene: str = "static", size: str = "tiny") -> Material:
    return material_of(Synthetic(scene=scene, size=size).scene)


def changed(material: Material, images: torch.Tensor, **others) -> Material:
    """The material with other images, in its views too."""
    views = [
        replace(view, thermal=image[..., None].float()) for view, image in zip(material.views, images, strict=True)
    ]
    return replace(material, images=images, views=views, **others)


def checks(material: Material) -> list[str]:
    return [finding.check for finding in examine(material)]


@pytest.mark.parametrize("scene", ["static", "heated", "cooling", "glass", "haze"])
def test_clean_recordings_raise_no_alarm(scene):
    assert examine(clean(scene)) == []


def test_findings_come_the_most_costly_first_and_say_what_helps():
    images = clean().images.clone()
    images[5], images[:, 3, 4], images[:, 20, 30] = images[4], 1.0, 1.0
    found = examine(changed(clean(), images))
    assert {"duplicates", "dead_pixels"} <= {one.check for one in found}
    assert [one.cost for one in found] == sorted((one.cost for one in found), reverse=True)
    assert all(one.remedy and 0 < one.cost <= 1.5 for one in found)


def test_drift_is_found_with_its_shutter_and_cooling_is_not_taken_for_it():
    count = len(clean().images)
    saw = 0.01 * (torch.arange(count, dtype=torch.float64) % 6)
    found = [one for one in examine(changed(clean(), clean().images + saw[:, None, None])) if one.check == "drift"]
    assert found and clean().name(6) in found[0].frames
    assert "drift" not in checks(clean("cooling"))


def test_poses_of_another_frame_are_found():
    cameras = list(clean().cameras)
    assert "poses" in checks(replace(clean(), cameras=cameras[5:] + cameras[:5]))


def test_a_lens_that_is_not_that_of_the_images_is_found():
    def longer(camera: Camera) -> Camera:
        K = camera.K.clone()
        K[0, 0] *= 1.25
        K[1, 1] *= 1.25
        return replace(camera, K=K)

    assert "poses" in checks(replace(clean(), cameras=[longer(camera) for camera in clean().cameras]))


def test_contrast_that_the_camera_stretches_is_no_temperature():
    gain = 1.0 + 0.4 * torch.sin(3.0 * torch.arange(len(clean().images), dtype=torch.float64))
    middle = clean().images.mean()
    wild = (middle + gain[:, None, None] * (clean().images - middle)).clamp(0, 1)
    assert "agc" in checks(changed(clean(), wild))
    low, high = clean().images.amin((1, 2), keepdim=True), clean().images.amax((1, 2), keepdim=True)
    assert "agc" in checks(changed(clean(), (clean().images - low) / (high - low), cameras=None, points=None))
    assert "agc" not in checks(
        changed(clean(), wild, unit_k=None, bounds_c=None)
    )  # greys that nobody calls temperatures


def test_pixels_beyond_the_bounds_and_bounds_that_nothing_uses_are_found():
    assert "bounds" in checks(replace(clean(), clipped=0.05))
    assert "bounds" in checks(changed(clean(), 0.5 + 0.05 * clean().images))
    assert "bounds" in checks(replace(clean(), bounds_c=(12000.0, 19000.0)))


def test_saturation_is_found():
    assert "saturation" in checks(
        changed(clean(), clean().images.clamp(max=float(clean().images.quantile(0.97))), clipped=0.0)
    )


def test_clocks_that_run_back_repeats_and_gaps_are_found():
    times = [10.0 * i for i in range(len(clean().names))]
    assert "times" not in checks(replace(clean(), times_s=times))
    assert "times" in checks(replace(clean(), times_s=[t if i < 8 else t - 55 for i, t in enumerate(times)]))
    assert "times" in checks(replace(clean(), times_s=[t if i < 8 else t + 500 for i, t in enumerate(times)]))
    assert "times" in checks(replace(clean(), times_s=[t - t % 20 for t in times]))


def test_blurred_frames_are_found():
    images = clean().images.clone()
    for f in (4, 9):
        images[f] = functional.avg_pool2d(
            functional.pad(images[f][None, None], (4, 4, 0, 0), mode="replicate"), (1, 9), stride=1
        )
    found = [one for one in examine(changed(clean(), images)) if one.check == "sharpness"]
    assert found and {clean().name(4), clean().name(9)} <= set(found[0].frames)


def test_points_that_few_views_see_are_found():
    far = torch.cat([clean().points, clean().points + torch.tensor([50.0, 0.0, 0.0])])
    assert "views" in checks(replace(clean(), points=far))


def test_photos_of_other_moments_and_photos_that_lie_beside_are_found():
    # A hand that sweeps: each frame shows what the one before did from a little further on.
    steps = [torch.roll(clean().images[0], 3 * f, 1) for f in range(10)]
    images = torch.stack(steps)
    photos = [image[..., None].expand(-1, -1, 3).float() for image in steps]
    about = {"names": [f"{i}" for i in range(10)], "times_s": None, "chosen": list(range(10)), "images": images}
    assert "pairing" not in checks(Material(**about, rgb=photos))
    assert "2 frame(s)" in next(
        f.what for f in examine(Material(**about, rgb=photos[2:] + photos[:2])) if f.check == "pairing"
    )
    aside = [torch.roll(photo, 5, 0) for photo in photos]
    assert "beside" in next(f.what for f in examine(Material(**about, rgb=aside)) if f.check == "pairing")


def test_clocks_of_two_cameras_that_disagree_are_found():
    times = [float(i) for i in range(len(clean().names))]
    late = replace(clean(), times_s=times, rgb_times_s=[t + 2.5 for t in times])
    assert any("+2.5 s" in one.what for one in examine(late))
    assert "pairing" not in checks(replace(clean(), times_s=times, rgb_times_s=times))


def test_every_check_says_what_it_looks_at():
    assert len({check.name for check in CHECKS}) == len(CHECKS) == 10
    assert all(check.summary for check in CHECKS)
