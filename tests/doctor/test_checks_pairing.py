"""Photos and thermal images that do not belong together are found."""

from dataclasses import replace

import torch
from materials import checks, clean, findings_of

from heatsplat.doctor.base import Material, coarse


def said(material: Material) -> str:
    """What the one finding of the check says."""
    (found,) = findings_of(material, "pairing")
    return found.what


def test_photos_of_other_moments_and_photos_that_lie_beside_are_found():
    # A hand that sweeps: each frame shows what the one before did from a little further on.
    steps = [torch.roll(clean().images[0], 3 * f, 1) for f in range(10)]
    images = torch.stack(steps)
    photos = [coarse(image) for image in steps]
    about = {"names": [f"{i}" for i in range(10)], "times_s": None, "chosen": list(range(10)), "images": images}
    assert "pairing" not in checks(Material(**about, photos=photos), only="pairing")
    assert "2 frame(s)" in said(Material(**about, photos=photos[2:] + photos[:2]))
    mixed = [photos[k] for k in (7, 3, 9, 0, 5, 8, 1, 4, 2, 6)]
    assert "do not fit" in said(Material(**about, photos=mixed))
    aside = [torch.roll(photo, 5, 0) for photo in photos]
    assert "beside" in said(Material(**about, photos=aside))


def test_clocks_of_two_cameras_that_disagree_are_found():
    times = [float(i) for i in range(len(clean().names))]
    late = replace(clean(), times_s=times, rgb_times_s=[t + 2.5 for t in times])
    assert "+2.5 s" in said(late)
    assert "pairing" not in checks(replace(clean(), times_s=times, rgb_times_s=times), only="pairing")


def test_a_black_photo_or_a_closed_shutter_says_nothing_of_the_others():
    images = torch.stack([torch.roll(clean().images[0], 3 * f, 1) for f in range(10)])
    photos = [coarse(image) for image in images]
    dark = [torch.zeros_like(photos[0]), *photos[1:]]
    shut = torch.cat([images[:5], torch.full_like(images[:1], 0.3), images[6:]])
    about = {"names": [f"{i}" for i in range(10)], "times_s": None, "chosen": list(range(10))}
    for heat, light in ((images, dark), (shut, photos), (shut, dark)):
        assert "pairing" not in checks(Material(**about, images=heat, photos=light), only="pairing")
        late = Material(**about, images=heat, photos=light[2:] + light[:2])
        found = said(late)
        assert "2 frame(s)" in found or "do not fit" in found


def test_images_of_a_few_pixels_say_nothing_of_how_photos_lie():
    images = torch.stack([torch.roll(clean().images[0], 3 * f, 1)[20:23, 20:24] for f in range(10)])
    about = {"names": [f"{i}" for i in range(10)], "times_s": None, "chosen": list(range(10))}
    assert findings_of(Material(**about, images=images, photos=[coarse(image) for image in images]), "pairing") == []
