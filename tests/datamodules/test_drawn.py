"""Scenes drawn at random: the same for a number, of every effect, recorded as they say."""

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.drawn import drawn
from heatsplat.datamodules.synthetic_scene.film import misplaced
from heatsplat.datamodules.synthetic_scene.outdoor import OutdoorPreset
from heatsplat.effects.catalogue import CATALOGUE

NOT_DRAWN = {"semi_infinite", "thermal_lag", "rolling_readout"}  # they need a camera that moves fast
NOT_DRAWN |= {"pixel_area"}  # sizes of images tell it
NOT_DRAWN |= {"view_dependence"}  # what neither mirrors nor emits less towards its sides is not drawn
NOT_DRAWN |= {"shadows", "sky_view", "albedo", "mirrored_sky"}  # no test of images tells them yet
COARSE = next(i for i in range(150) if (one := drawn(i)).bits == 8 and one.pose_error_px > 0.1)


def test_a_number_is_a_scene():
    assert drawn(3) == drawn(3) != drawn(4)


def test_every_effect_is_drawn_and_left_out_and_no_condition_is_missing():
    many = [drawn(number) for number in range(150)]
    shown = [one.preset.effects for one in many]
    for effect in (one for one in CATALOGUE if one.name not in NOT_DRAWN):
        assert 0 < sum(effect.name in effects for effects in shown) < len(many), effect.name
    assert sum(not effects for effects in shown) > 5
    assert {one.bits for one in many} == {8, 16}
    assert min(one.frames for one in many) < 12 and max(one.frames for one in many) > 40
    assert any(one.pose_error_px == 0 for one in many) and max(one.pose_error_px for one in many) > 0.8
    yards = [one.preset for one in many if isinstance(one.preset, OutdoorPreset)]
    assert any(yard.part_s for yard in yards) and any("radiation" not in yard.effects for yard in yards)


@pytest.mark.parametrize("number", [COARSE])
def test_a_scene_is_recorded_as_it_was_drawn(number):
    told = drawn(number)
    module = Synthetic(scene=f"drawn_{number}", size="tiny")
    scene = module.scene
    assert scene.notes["effects"] == sorted(told.preset.effects)
    assert len(scene.train) + len(scene.test) == told.frames
    levels = scene.train[0].thermal * 255
    torch.testing.assert_close(levels, levels.round(), atol=1e-3, rtol=0)
    exact = Synthetic(scene=f"drawn_{number}", size="tiny", pose_error_px=0.0, bits=16).scene
    turned = [a.camera.viewmat - b.camera.viewmat for a, b in zip(scene.train.frames, exact.train.frames, strict=True)]
    assert torch.stack(turned).abs().max() > 1e-4
    fine = exact.train[0].thermal * 255
    assert (fine - fine.round()).abs().max() > 0.1


def test_cameras_are_misplaced_by_so_many_pixels():
    class Recording:
        lens = type("Lens", (), {"fx": 70.0, "fy": 70.0})
        viewmats = torch.eye(4, dtype=torch.float64).expand(400, 4, 4).numpy()

    turned = torch.from_numpy(misplaced(Recording, 0.5, seed=1))
    straight_ahead = 70.0 * turned[:, :2, 2] / turned[:, 2:3, 2]  # where the image's middle has gone
    torch.testing.assert_close(straight_ahead.std(0), torch.full((2,), 0.5, dtype=torch.float64), rtol=0.1, atol=0)
    assert misplaced(Recording, 0.0, seed=1) is Recording.viewmats


def test_what_cannot_be_recorded_is_refused():
    with pytest.raises(SceneError, match="images are stored in 8 or 16 bits"):
        Synthetic(scene="static", bits=12)
    with pytest.raises(SceneError, match="data.pose_error_px=-1"):
        Synthetic(scene="static", pose_error_px=-1)
    with pytest.raises(SceneError, match="drawn_0, drawn_1 and so on"):
        Synthetic(scene="drawn_x")
