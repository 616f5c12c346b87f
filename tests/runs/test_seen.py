"""Which pixels of a render show what training views have seen: by the surface, of the render and of the views."""

from dataclasses import replace
from types import SimpleNamespace

import torch
from weathered import make_scene

from heatsplat.contracts import View, ViewSet
from heatsplat.runs.run import Trained

BEFORE, BEHIND = 4.0, 8.0


def trained(depth_of):
    """A run whose scene shows surfaces at these depths, and knows no other depth."""
    frames = make_scene().train.frames
    scene = SimpleNamespace(train=ViewSet(frames, lambda i: View(frames[i])))

    def surface(frame):
        return torch.full((frame.camera.height, frame.camera.width), depth_of(frame))

    module = SimpleNamespace(surface=surface, cameras=SimpleNamespace(of=lambda frame: frame.camera), scene=scene)
    return Trained({}, module, SimpleNamespace(scene=scene), {})


def test_what_lies_on_the_surface_that_views_saw_was_seen_and_what_lies_behind_it_was_not():
    frame = replace(make_scene().train.frames[0], frame_id=999)
    assert trained(lambda _: BEFORE).seen(frame).all()
    behind = trained(lambda one: BEHIND if one.frame_id == frame.frame_id else BEFORE).seen(frame)
    assert not behind.any()
