"""What a doctor looks at is that of the scene."""

from dataclasses import replace

import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import Material, coarse, material_of


def test_the_material_has_the_training_views_with_their_unit_and_names():
    scene = Synthetic(scene="static", size="tiny").scene
    material = material_of(scene)
    assert material.names == [frame.name for frame in scene.train.frames]
    assert material.unit_k == scene.thermal_range.span_k and material.name(3) == material.names[material.chosen[3]]
    torch.testing.assert_close(material.image(2), scene.train[2].thermal[..., 0].double())
    assert 0 < material.noise < material.contrast
    for source in (
        "info.json",
        "data.min_c and data.max_c: the data set keeps them in its code",
        "info.json (swapped)",
    ):
        told = material_of(replace(scene, notes=scene.notes | {"bounds_source": source})).bounds_in
        assert told == ("info.json" if "info" in source else "data.min_c and data.max_c")


def test_what_a_mask_leaves_out_and_what_is_unknown_do_not_count():
    images = torch.arange(12.0, dtype=torch.float64).reshape(1, 3, 4)
    images[0, 0, 0] = torch.nan
    masks = torch.ones(1, 3, 4, dtype=torch.bool)
    masks[0, 2, 3] = False
    material = Material(["a"], None, [0], images, masks=masks)
    assert material.known(0).tolist() == [float(i) for i in range(1, 11)]
    assert material.size(0.5) == "50 % of the range" and replace(material, unit_k=4.0).size(0.5) == "2 K"


def test_frames_of_which_nothing_counts_leave_the_contrast_as_it_is():
    scene = Synthetic(scene="static", size="tiny").scene
    material = material_of(scene)
    masks = torch.ones(material.images.shape, dtype=torch.bool)
    masks[2] = False
    assert abs(replace(material, masks=masks).contrast / material.contrast - 1.0) < 0.1
    assert replace(material, masks=masks & False).contrast > 0


def test_of_photos_only_a_coarse_brightness_is_kept():
    scene = Synthetic(scene="static", size="demo", frames=8).scene
    photos, bright = material_of(scene).photos, scene.train[2].rgb.double().mean(2)
    assert [tuple(photo.shape) for photo in photos] == [(64, 80)] * len(scene.train)
    torch.testing.assert_close(photos[2], bright.reshape(64, 2, 80, 2).mean((1, 3)), rtol=0, atol=1e-6)
    assert torch.equal(coarse(photos[2]), photos[2])
