"""Blurred frames are found."""

from materials import changed, clean
from torch.nn import functional

from heatsplat.doctor.examination import examine


def test_blurred_frames_are_found():
    images = clean().images.clone()
    for f in (4, 9):
        images[f] = functional.avg_pool2d(
            functional.pad(images[f][None, None], (4, 4, 0, 0), mode="replicate"), (1, 9), stride=1
        )
    found = [one for one in examine(changed(clean(), images)) if one.check == "sharpness"]
    assert found and {clean().name(4), clean().name(9)} <= set(found[0].frames)
