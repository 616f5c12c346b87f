"""The frames that a run was trained on, as its checkpoint tells them, and what has become of them in the data since.

A folder that is prepared again has another coordinate system, and often other frames: a trained scene would be looked at from
wrong places there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError
from heatsplat.geometry.projection import eyes

# Below these nothing moved: the last digits of a file, or the pixel counts of a smaller image.
TURNED = 1e-4  # rad
MOVED = 1e-4  # distance, in median distances of the training cameras from their middle
STILL = 1e-2  # of the scene's extent, which that is at least: a camera on a tripod has none
LENS = 1e-3  # of the image's width or height
LATER_S = 1e-2


def frames_of(scene: SceneData) -> dict[str, Any]:
    """What a checkpoint tells of the frames of a scene.

    "names" and "frame_ids" of the n training frames in their order, "viewmats" [n, 4, 4], "lenses" [n, 4] (focal lengths and
    principal point in widths and heights of the image), "times_s" [n], NaN where there are none, all float64; and "held_out",
    the names of all others.
    """
    frames = scene.train.frames
    names = [frame.name for frame in frames]
    known = set(names)
    return {
        "names": names,
        "frame_ids": [frame.frame_id for frame in frames],
        "viewmats": torch.stack([frame.camera.viewmat for frame in frames]),
        "lenses": torch.stack([_lens(frame) for frame in frames]),
        "times_s": _times(frames),
        "held_out": [frame.name for frame in scene.frames if frame.name not in known],
    }


def check_frames(
    before: Mapping[str, Any] | None, scene: SceneData, *, exactly: bool = False, numbered: bool = False
) -> None:
    """Raises SceneError where a scene is not the one whose frames a checkpoint tells of (``frames_of``), with what changed.

    Args:
        before: what it tells; None, as of an older heatsplat, is not held against anything.
        scene: on the clock of the checkpoint.
        exactly: the training frames have to be the same, as for training that goes on. Otherwise the data may be divided in
            another way, and have more or fewer test frames.
        numbered: those that are left have to have the same numbers, as for a model that knows frames by them. So they have where
            they are the same.
    """
    if before is not None and (changes := list(_changes(before, scene, exactly, numbered or exactly))):
        raise SceneError(
            f"the data of scene '{scene.name}' are not those of training: {'; '.join(changes)}. Give the data as they were "
            "(data.root, data.scene, data.split), or train again, in another folder"
        )


def camera_movement(before: Mapping[str, Any], frames: Iterable[Frame], scene: SceneData) -> str | None:
    """How far the cameras of those frames moved that a checkpoint tells of, in words; None where they did not.

    Args:
        before: what it tells (``frames_of``).
        frames: as they are now; those of other names do not count, and of several of one name the first does.
        scene: whose they are.
    """
    rows = _rows(before["names"])
    now = {frame.name: frame for frame in reversed([*frames]) if frame.name in rows}
    if not now:
        return None
    in_both = [rows[name] for name in now]
    old, new = before["viewmats"][in_both], torch.stack([frame.camera.viewmat for frame in now.values()])
    distances = (eyes(old) - eyes(new)).norm(dim=1)
    turns = old[:, :3, :3] - new[:, :3, :3]  # its norm is 2 sqrt(2) sin(angle / 2)
    angles = 2 * (turns.norm(dim=(1, 2)) / math.sqrt(8)).clamp(max=1).asin()
    all_centers = eyes(before["viewmats"])
    spread = max(float((all_centers - all_centers.mean(0)).norm(dim=1).median()), STILL * scene.extent)
    elsewhere = (distances > MOVED * spread) | (angles > TURNED)
    if bool(elsewhere.any()):
        return (
            f"the cameras of {int(elsewhere.sum())} of its {len(rows)} training frames moved by up to "
            f"{float(distances.max()):.3g} world units and {math.degrees(float(angles.max())):.3g} degrees"
        )
    lens_changes = before["lenses"][in_both] - torch.stack([_lens(frame) for frame in now.values()])
    other_lens = (lens_changes.abs() > LENS).any(dim=1)
    if bool(other_lens.any()):
        return (
            f"{int(other_lens.sum())} of its {len(rows)} training frames have another focal length or principal point"
        )
    return None


def _changes(before: Mapping[str, Any], scene: SceneData, exactly: bool, numbered: bool) -> Iterator[str]:
    """What changed, each in words (``check_frames``)."""
    names, train = before["names"], scene.train.frames
    now = {frame.name: frame for frame in reversed(train if exactly else scene.frames)}  # training frames come first
    known = {*names} if exactly else {*names, *before["held_out"]}
    if missing := [name for name in names if name not in now]:
        yield f"{_counted(missing)} less"
    if added := [frame.name for frame in train if frame.name not in known]:
        yield f"{_counted(added)} more"
    if movement := camera_movement(before, now.values(), scene):
        yield movement
    in_both = [(row, now[name]) for name, row in _rows(names).items() if name in now]
    if not in_both:
        return
    shifts = before["times_s"][[row for row, _ in in_both]] - _times([frame for _, frame in in_both])
    shifts = shifts.abs().nan_to_num(0.0)
    if float(shifts.max()) > LATER_S:
        yield f"times of {int((shifts > LATER_S).sum())} training frames differ by up to {float(shifts.max()):.6g} s"
    ids = [before["frame_ids"][row] for row, _ in in_both]
    if numbered and not missing and not added and ids != [frame.frame_id for _, frame in in_both]:
        yield "its frames are numbered in another way, as by test frames that were added or removed"


def _rows(names: Sequence[str]) -> dict[str, int]:
    """Place of each name; of frames of one name that of the first."""
    return {names[row]: row for row in reversed(range(len(names)))}


def _counted(names: Sequence[str]) -> str:
    return f"{len(names)} training frame{'s' * (len(names) > 1)} ({', '.join(names[:3])}{', ...' * (len(names) > 3)})"


def _lens(frame: Frame) -> Tensor:
    camera = frame.camera
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    lens = [fx / camera.width, fy / camera.height, cx / camera.width, cy / camera.height]
    return torch.tensor(lens, dtype=torch.float64)


def _times(frames: Sequence[Frame]) -> Tensor:
    times = [math.nan if frame.time_s is None else frame.time_s for frame in frames]
    return torch.tensor(times, dtype=torch.float64)
