"""What a trained scene shows of a training image whose camera was learned: each answer is of one camera throughout."""

from dataclasses import replace

import pytest
import torch
from running import TINY, run

from heatsplat.callbacks.surfaces import look
from heatsplat.geometry.coverage import surface_depth
from heatsplat.shots import first_free_id
from heatsplat.uncertainty import evidence


@pytest.fixture(scope="module")
def far_off(tmp_path_factory):
    """A run that learned that its cameras were turned by six pixels."""
    settings = (*TINY, "method=3dgs", "data.scene=static", "max_steps=20", "cameras=refined", "test=false")
    module, _ = run(tmp_path_factory.mktemp("far_off"), *settings)
    with torch.no_grad():
        module.cameras.moves[:, 1] = 6.0
    return module


def test_hot_surfaces_lie_where_rays_of_the_same_camera_meet_them(far_off):
    frame = far_off.scene.train.frames[2]
    seen = look(far_off, frame)
    assert torch.equal(seen.depth, far_off.surface(frame)) and seen.camera is frame.camera
    moved = far_off.render(frame, depth=True)
    assert not torch.equal(surface_depth(moved.depth, moved.alpha[0]), seen.depth)


def test_residuals_belong_to_the_gaussians_that_the_moved_camera_sees(far_off):
    view = far_off.scene.train[2]
    stood = far_off.cameras.of(view.frame)
    stood = replace(stood, viewmat=stood.viewmat.detach())
    elsewhere = replace(view, frame=replace(view.frame, camera=stood, frame_id=first_free_id(far_off.scene)))
    found, expected = (evidence(far_off, [one]) for one in (view, elsewhere))
    torch.testing.assert_close(found.weight, expected.weight)
    torch.testing.assert_close(found.misfit, expected.misfit)
