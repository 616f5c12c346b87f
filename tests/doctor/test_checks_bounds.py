"""Pixels beyond their bounds and saturation are found."""

from dataclasses import replace

import torch
from materials import changed, checks, clean, findings_of


def test_pixels_beyond_the_bounds_and_bounds_that_nothing_uses_are_found():
    assert "bounds" in checks(replace(clean(), clipped=0.05), only="bounds")
    assert "bounds" in checks(changed(clean(), 0.5 + 0.05 * clean().images), only="bounds")
    assert "bounds" in checks(replace(clean(), bounds_c=(12000.0, 19000.0)), only="bounds")


def test_temperatures_that_are_kelvin_or_of_another_scale_are_found():
    unit = clean().images.double()
    for images, unit_k, bounds_c, said in (
        (unit, 34.0, (295.0, 329.0), "All pixels lie within 295 .. 329 °C, which may be kelvin of 21.85 .. 55.85 °C."),
        (295.0 + 20.0 * unit, 1.0, None, "which may be kelvin of"),
        (-80.0 + 18.0 * unit, 1.0, None, "°C (median)"),
    ):
        files = replace(clean(), images=images, unit_k=unit_k, bounds_c=bounds_c, stored="celsius", cameras=None)
        assert any(said in f.what and "counts.scale" in f.remedy for f in findings_of(files, "bounds"))
    day, furnace, sky_above_ground = 40.0 * unit, 500.0 * unit + 250.0, 300.0 * unit - 90.0
    for celsius in (day, furnace, sky_above_ground):
        assert "bounds" not in checks(replace(clean(), images=celsius, unit_k=1.0, bounds_c=None), only="bounds")


def test_the_remedy_for_another_unit_is_one_that_such_files_have():
    kelvin = replace(clean(), bounds_c=(295.0, 329.0), unit_k=34.0)
    for stored, posed, helps in (
        ("celsius", True, "prepare.py source=IMAGES target=FOLDER counts.offset_c=-273.15"),
        ("counts", True, "data.raw_scale * count + data.raw_offset_c"),
        ("grey8", True, "data.bounds_c"),
        ("radiometric", True, "counts.planck"),
        ("celsius", False, "counts.scale * number + counts.offset_c"),
        ("grey8", False, "bounds_c or temperature_bounds.json"),
    ):
        found = findings_of(replace(kelvin, stored=stored, cameras=clean().cameras if posed else None), "bounds")
        (remedy,) = (one.remedy for one in found if "may be kelvin" in one.what)
        assert helps in remedy and ("data." in remedy) == (posed and stored in ("counts", "grey8"))


def test_the_remedy_names_what_gave_the_bounds():
    of_rhd = replace(clean(), stored="grey8", bounds_in="info.json")
    wrong = (replace(of_rhd, clipped=0.05), replace(of_rhd, bounds_c=(295.0, 329.0), unit_k=34.0))
    for found in (findings_of(material, "bounds")[0] for material in wrong):
        assert "(info.json)" in found.remedy and "data.bounds_c" not in found.remedy


def test_floats_that_are_shares_of_a_range_are_found():
    """As heatsplat reads them, with the bounds that it takes from them, and as a preparation does."""
    scene = replace(clean(), bounds_c=(0.02, 0.98), unit_k=0.96, bounds_chosen=True, stored="celsius")
    files = replace(
        clean(), images=clean().images.clamp(0, 1), bounds_c=None, unit_k=1.0, stored="celsius", cameras=None
    )
    for material in (scene, files):
        (found,) = findings_of(material, "bounds")
        assert "may be shares of a range" in found.what and "counts.scale=SPAN counts.offset_c=MIN" in found.remedy
        assert ("prepare.py" in found.remedy) is (material is scene)
    assert findings_of(replace(scene, bounds_c=(-0.4, 0.9), unit_k=1.3), "bounds") == []
    assert findings_of(replace(scene, bounds_chosen=False), "bounds") == []


def test_greys_that_are_kelvin_x_100_are_found():
    def greys(low: float, high: float, stored: str = "grey16") -> list[str]:
        """What is found of 16-bit greys between two counts."""
        images = (low + (high - low) * clean().images.double()) / 65535
        seen = replace(clean(), images=images, unit_k=None, bounds_c=None, clipped=None, stored=stored)
        return [one.what + one.remedy for one in findings_of(seen, "bounds")]

    (said,) = greys(28500.0, 31500.0)
    assert "kelvin x 100" in said and "data.raw=images data.raw_scale=0.01" in said and "prepare.py" in said
    assert greys(0.0, 65535.0) == greys(12000.0, 13500.0) == greys(28500.0, 31500.0, stored="grey8") == []


def test_kelvin_x_100_between_bounds_are_not_told_to_narrow_them():
    """They would all be told to have about the middle of the bounds."""
    images = (30000.0 + 2000.0 * clean().images.clamp(0, 1).double()) / 65535  # 26.85 .. 46.85 °C
    seen = replace(clean(), images=images, unit_k=30.0, bounds_c=(23.0, 53.0), clipped=None, stored="grey16")
    (found,) = findings_of(seen, "bounds")
    assert "kelvin x 100" in found.what and "bounds 23 .. 53 °C" in found.what and "are taken for 36.7" in found.what
    assert "data.raw_scale=0.01" in found.remedy and found.cost > 0.5
    (other,) = findings_of(replace(seen, bounds_c=(100.0, 130.0)), "bounds")  # greys in earnest
    assert "kelvin" not in other.what and "Narrow the bounds" in other.remedy


def test_bounds_that_cut_off_are_not_to_be_narrowed():
    found = findings_of(changed(clean(), 0.02 * clean().images, clipped=0.9), "bounds")
    assert [one.remedy.split()[1] for one in found] == ["wider"]


def test_bounds_that_heatsplat_chose_are_named_so_and_blame_no_camera():
    top = float(clean().images.quantile(0.97))
    at_bound = changed(clean(), (clean().images / top).clamp(max=1.0), clipped=0.004)
    (given,) = findings_of(at_bound, "bounds")
    assert given.check == "bounds" and "upper bound" in given.what and "wider" in given.remedy
    assert findings_of(replace(at_bound, bounds_chosen=True), "bounds") == []
    (cut,) = findings_of(replace(at_bound, bounds_chosen=True, clipped=0.03), "bounds")
    assert "which heatsplat took from the training images" in cut.what and "same export" not in cut.remedy
    narrow = replace(clean(), images=0.1 * clean().images, bounds_c=(0.0, 500.0), clipped=0.0, bounds_chosen=True)
    (unused,) = findings_of(narrow, "bounds")
    assert "99.8 % of the pixels lie within" in unused.what and "masks/" in unused.remedy
    wide = replace(narrow, images=0.02 * clean().images, bounds_c=(0.0, 900.0))  # a single pixel of 900 °C
    assert len(findings_of(wide, "bounds")) == 1
    kelvin = replace(narrow, images=0.4 + 0.1 * clean().images, bounds_c=(0.0, 700.0))  # and one of 0 K
    assert any("may be kelvin" in one.what for one in findings_of(kelvin, "bounds"))
    saturated = changed(clean(), 0.9 * (clean().images / top).clamp(max=1.0), clipped=0.0, bounds_chosen=True)
    assert "saturation" in checks(saturated, only="bounds")


def test_saturation_is_found():
    assert "saturation" in checks(
        changed(clean(), clean().images.clamp(max=float(clean().images.quantile(0.97))), clipped=0.0), only="bounds"
    )


def test_images_that_are_constant_do_not_saturate():
    assert "saturation" not in checks(
        changed(clean(), torch.full_like(clean().images, 0.5), clipped=0.0), only="bounds"
    )
