import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.aligned_cameras import checked_skew, numbers_in, world_to_camera


def test_a_pose_becomes_its_inverse():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    viewmat = world_to_camera(turn, np.array([1.0, 2.0, 3.0]), "here")
    np.testing.assert_allclose(viewmat @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(viewmat[:3, :3], turn.T)
    with pytest.raises(SceneError, match="here is no pose"):
        world_to_camera(2 * turn, np.zeros(3), "here")


def test_a_skew_is_told_and_from_a_quarter_of_a_pixel_on_refused():
    assert checked_skew(0.0, 100.0, 50.0, 100, "b2", "mend it") == []
    assert checked_skew(0.4, 100.0, 40.0, 100, "b2", "mend it")[0].endswith("it moves pixels by at most 0.24.")
    with pytest.raises(SceneError, match="b2 is -0.5, a skew that moves pixels by up to 0.30 .*; mend it"):
        checked_skew(-0.5, 100.0, 40.0, 100, "b2", "mend it")


def test_numbers_are_as_many_as_are_needed_and_finite():
    assert numbers_in(" 1  -2e3\n3.5", 3, "here", "mend it").tolist() == [1.0, -2000.0, 3.5]
    for text, said in ((None, "2 numbers are needed, it has 0"), ("1 x", "'x'"), ("1 inf", "not finite")):
        with pytest.raises(SceneError, match=f"here: .*{said}.*; mend it"):
            numbers_in(text, 2, "here", "mend it")
