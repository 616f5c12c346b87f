"""Frames that show nothing are named, and no other check takes them for something else."""

import pytest
import torch
from materials import changed, checks, clean, findings_of


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_closed_shutter_is_neither_gain_control_nor_blur(noise):
    images = clean().images.clone()
    level = images.mean() + noise * clean().noise * torch.randn(
        images.shape[1:], generator=torch.Generator().manual_seed(0)
    )
    images[5] = level
    material = changed(clean(), images)
    (found,) = findings_of(material, "blank")
    assert found.frames == (clean().name(5),) and f"1 of {len(images)} frames" in found.what
    assert checks(material) == ["blank"]


def test_recordings_of_little_contrast_have_no_blank_frames():
    assert findings_of(clean(), "blank") == []
    faint = clean().images.clone()
    faint[5] = faint[5].mean() + 0.2 * (faint[5] - faint[5].mean())  # most of it is far away
    assert findings_of(changed(clean(), faint), "blank") == []


def test_a_recording_of_one_temperature_shows_nothing():
    images = torch.full_like(clean().images, 0.1)
    (found,) = findings_of(changed(clean(), images), "blank")
    assert f"{len(images)} of {len(images)} frames have one level all over" in found.what and "others" not in found.what
    assert found.remedy.startswith("Record or export them again")
    assert {"agc", "sharpness", "duplicates"}.isdisjoint(checks(changed(clean(), images)))
