"""What is held out of a recording: stretches of time, one side, and every so many of the rest."""

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.parts import parts_of
from heatsplat.datamodules.synthetic_scene.paths import camera_path, frame_times


def recorded(count: int) -> tuple[np.ndarray, np.ndarray]:
    times = frame_times(count, 1800.0, 0)
    return times, camera_path(times, 1800.0, 0).numpy()


def test_every_part_is_what_it_says():
    times, viewmats = recorded(120)
    parts = np.array(parts_of(times, viewmats, near=8, views=0.12, times=[[0.45, 0.55], [0.9, 1.0]]))
    share = (times - times[0]) / (times[-1] - times[0])
    within = ((share >= 0.45) & (share <= 0.55)) | (share >= 0.9)
    assert np.array_equal(parts == "times", within)
    centers = -np.einsum("fji,fj->fi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    angle = np.degrees(np.arctan2(centers[:, 0], -centers[:, 1]))
    assert angle[parts == "views"].min() > angle[(parts == "train") | (parts == "near")].max() + 0.01
    assert (parts == "views").sum() == round(0.12 * (~within).sum())
    left = np.nonzero((parts == "train") | (parts == "near"))[0]
    assert np.array_equal(np.nonzero(parts[left] == "near")[0], np.arange(4, len(left), 8))
    assert (parts == "train").sum() > 60


def test_shares_that_leave_nothing_are_refused():
    times, viewmats = recorded(19)
    with pytest.raises(SceneError, match=r"data.parts.gap: \[0.5, 0.2\] is no stretch"):
        parts_of(times, viewmats, gap=[[0.5, 0.2]])
    with pytest.raises(SceneError, match="leaves 0 of 19 frames"):
        parts_of(times, viewmats, all=[[0.0, 1.0]])
    for wrong in ({"near": 0}, {"views": 1.5}, {"views": -0.1}):
        with pytest.raises(SceneError, match="data.parts: near counts frames"):
            parts_of(times, viewmats, **wrong)


@pytest.mark.parametrize("scene", ["facade", "outdoor", "cooling"])
def test_a_scene_in_parts_trains_on_its_training_part_alone(scene):
    views = Synthetic(scene=scene, size="tiny", split="parts", parts={"near": 4}).scene
    assert {frame.name.partition("_")[0] for frame in views.train.frames} == {"train"}
    assert {frame.name.partition("_")[0] for frame in views.test.frames} == {"near", "views"}
