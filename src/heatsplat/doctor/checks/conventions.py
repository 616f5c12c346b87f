"""Poses that were written in another convention than the one they are read in: other camera axes, or the inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Camera, evenly_spread
from heatsplat.doctor.base import Check, Finding, Material, coarse
from heatsplat.effects.observations import in_view
from heatsplat.geometry.transforms import OPENGL_AXES

# Pairs of frames between which the camera turned, by an angle that does not depend on the convention; else neighbours.
PAIRS, MIN_PAIRS = 12, 4
TURN, USUAL = (4.0, 20.0), 10.0  # degrees
SIDE = 32  # pixels of the shorter side of images that are laid on each other: what lies beside by a little still fits
PLANES = 17  # distances at which the scene may lie, down to one from which a point moves by half an image
OVERLAP = 0.25  # share of an image that has to be in the other one
# Correlation that another reading has to gain, in most pairs; where one is misread it is 0.2 to 0.9 in the median.
MOST, BETTER = 0.75, 0.1
GAINED = 0.25  # of what another reading gains over images that did not move, a misread one gains less; often it loses
ALIKE = 1.001  # more than any correlation, with its rounding
UNMOVED = "unmoved"  # beside the readings: images that lie on each other as they are
CAMERAS, SOME = 32, 2000  # that are asked what they see, and points
NONE_SEEN, SEEN = 0.1, 0.5  # shares of points in view of a misread and of a right reading
BLIND, SEEING = 0.5, 0.9  # the same for the share of cameras that see any

# What a matrix can be: whether it leads from the camera to the world, and whether camera axes are those of OpenGL.
READINGS = {
    "camera-to-world in OpenGL axes": (True, True),
    "camera-to-world in OpenCV axes": (True, False),
    "world-to-camera in OpenCV axes": (False, False),
    "world-to-camera in OpenGL axes": (False, True),
}
TURN_AXES = {True: "[:3, 1:3] *= -1", False: "[1:3] *= -1"}  # of a matrix from, and one to the camera


def find(material: Material) -> list[Finding]:
    cameras = material.cameras
    if cameras is None or len(cameras) < MIN_PAIRS:
        return []
    given = material.poses_are
    fitted = _fits(material)
    if fitted is not None:
        fits = {name: fitted(name) for name in (given, UNMOVED)}
        own, most = fits[given] - fits[UNMOVED], ALIKE - fits[UNMOVED]
        other = None
        if float(own.median()) < GAINED * float(most.median()):  # of more than that, no reading gains enough
            fits |= {name: fitted(name) for name in READINGS if name != given}
            other = _fitting(fits, given)
        if other is not None:
            apart = f"{float(fits[other].median()):.2f} instead of {float(fits[given].median()):.2f}"
            return [_told(material, other, f"neighbouring images laid on each other correlate to {apart}")]
        if float(own.median()) > BETTER:
            return []
    seen = _seen(material)
    other = max(seen, key=lambda one: seen[one][0])
    (points, seeing), (others, see) = seen[given], seen[other]
    if points > NONE_SEEN or seeing > BLIND or others < SEEN or see < SEEING:
        return []
    return [
        _told(
            material,
            other,
            f"{100 * others:.0f} % of the points lie in view of cameras instead of {100 * points:.0f} %",
        )
    ]


def _told(material: Material, other: str, better: str) -> Finding:
    """The finding that poses are ``other`` and not what they are read as."""
    (to_world, opengl), (other_to_world, other_opengl) = READINGS[material.poses_are], READINGS[other]
    steps = [] if to_world == other_to_world else ["M = numpy.linalg.inv(M)"]
    if opengl != other_opengl:
        steps.append(f"M{TURN_AXES[to_world]}")
    return Finding(
        "conventions",
        1.5,
        f"Poses of {material.poses_in} are read as {material.poses_are}, but look like {other}: read so, {better}.",
        f"Convert the matrix M of every pose: {'; '.join(steps)}",
    )


def _views_of(material: Material, cameras: list[Camera]) -> dict[str, list[Camera]]:
    """The cameras that the same matrices give under every reading."""
    axes = torch.from_numpy(OPENGL_AXES)
    # Matrices are of the world of the file, of which large coordinates were subtracted.
    place = torch.eye(4, dtype=torch.float64)
    place[:3, 3] = torch.tensor(material.origin, dtype=torch.float64)
    viewmats = torch.stack([camera.viewmat for camera in cameras]) @ torch.linalg.inv(place)
    to_world, opengl = READINGS[material.poses_are]
    matrices = axes @ viewmats if opengl else viewmats
    matrices = torch.linalg.inv(matrices) if to_world else matrices
    found = {}
    for name, (from_camera, is_opengl) in READINGS.items():
        if name == material.poses_are:
            found[name] = cameras
            continue
        read = torch.linalg.inv(matrices) if from_camera else matrices
        read = (axes @ read if is_opengl else read) @ place
        found[name] = [replace(camera, viewmat=view) for camera, view in zip(cameras, read, strict=True)]
    return found


def _fitting(fits: dict[str, Tensor], given: str) -> str | None:
    """Another reading under which images fit each other, where they do not under the given one."""
    best = max((name for name in READINGS if name != given), key=lambda name: float(fits[name].median()))
    gain, own = fits[best] - fits[UNMOVED], fits[given] - fits[UNMOVED]
    better = float(((gain > 0) & (gain - own > BETTER)).double().mean())
    return best if better >= MOST and float(own.median()) < GAINED * float(gain.median()) else None


def _fits(material: Material) -> Callable[[str], Tensor] | None:
    """How well images fit each other [pairs] under a reading, or UNMOVED; None of too few."""
    pairs = _pairs(material)
    if len(pairs) < MIN_PAIRS:
        return None
    used = sorted({frame for pair in pairs for frame in pair})
    small = {frame: _small(material, frame) for frame in used}
    lenses = {}
    for frame in used:
        camera, (height, width) = material.cameras[frame], small[frame].shape
        scale = camera.K.new_tensor([width / camera.width, height / camera.height, 1.0])
        lenses[frame] = scale[:, None] * camera.K
    views = {name: [camera.viewmat for camera in read] for name, read in _views_of(material, material.cameras).items()}
    views[UNMOVED] = [torch.eye(4, dtype=torch.float64)] * len(material.cameras)

    def fitted(name: str) -> Tensor:
        view = views[name]
        found = [_fit(small[i], small[j], lenses[i], lenses[j], view[i], view[j]) for i, j in pairs]
        return torch.tensor(found, dtype=torch.float64)

    return fitted


def _pairs(material: Material) -> list[tuple[int, int]]:
    """Frames that were taken soon after each other, between which the camera turned by about ``USUAL`` degrees; where it did not
    turn so, such as above fields, neighbours."""
    turns = torch.stack([camera.viewmat[:3, :3] for camera in material.cameras])
    found = []
    for one in evenly_spread(len(turns), PAIRS):
        trace = (turns * turns[one]).sum((1, 2))
        angle = torch.rad2deg(torch.arccos((0.5 * (trace - 1.0)).clamp(-1.0, 1.0)))
        usable = (angle > TURN[0]) & (angle < TURN[1]) & material.near_in_time(one)
        if usable.any():
            found.append((one, int(torch.where(usable, (angle - USUAL).abs(), torch.inf).argmin())))
    if len(found) >= MIN_PAIRS:
        return found
    return [(one, one + 1) for one in evenly_spread(len(turns) - 1, PAIRS) if material.near_in_time(one)[one + 1]]


def _small(material: Material, frame: int) -> Tensor:
    """A frame [h, w] with SIDE pixels along its shorter side; its mean where nothing is known."""
    image, counts = material.image(frame), material.counts(frame)
    image = torch.where(counts, image, image[counts].mean() if counts.any() else 0.0)
    return coarse(image, SIDE)


def _fit(one: Tensor, other: Tensor, lens: Tensor, other_lens: Tensor, view: Tensor, other_view: Tensor) -> float:
    """The best correlation of an image with another one that is laid on it by planes at some distances; -1 without overlap."""
    turn = other_view[:3, :3] @ view[:3, :3].T
    move = other_view[:3, 3] - turn @ view[:3, 3]
    height, width = one.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).double()
    rays = pixels @ torch.linalg.inv(lens).T @ turn.T
    nearest = 0.5 * width / float(lens[0, 0] * move.norm().clamp_min(1e-12))  # as an inverse distance
    steps = torch.linspace(0.0, nearest, PLANES, dtype=torch.float64) if move.norm() > 0 else torch.zeros(1).double()
    there = (rays + steps[:, None, None] * move) @ other_lens.T
    extent = pixels.new_tensor([other.shape[1], other.shape[0]])
    places = there[..., :2] / there[..., 2:].clamp_min(1e-9)
    inside = ((there[..., 2] > 1e-6) & (places > 0).all(-1) & (places < extent).all(-1)).double()
    values = functional.grid_sample(
        other[None, None], (2.0 * places / extent - 1.0).clamp(-2.0, 2.0)[None], align_corners=False
    )[0, 0]
    count = inside.sum(1, keepdim=True).clamp_min(1.0)
    first, second = (
        inside * (v - (inside * v).sum(1, keepdim=True) / count) for v in (one.reshape(1, -1).expand_as(values), values)
    )
    alike = (first * second).sum(1) / (first.norm(dim=1) * second.norm(dim=1)).clamp_min(1e-12)
    return float(torch.where(inside.mean(1) >= OVERLAP, alike, -1.0).max())


def _seen(material: Material) -> dict[str, tuple[float, float]]:
    """Share of the points that any camera sees under each reading, and of the cameras that see any; 0 without points."""
    if material.points is None or not len(material.points):
        return dict.fromkeys(READINGS, (0.0, 0.0))
    points = material.points[:: max(1, len(material.points) // SOME)].double()
    cameras = list(material.all_cameras or material.cameras)
    cameras = [cameras[i] for i in evenly_spread(len(cameras), CAMERAS)]
    found = {}
    for name, read in _views_of(material, cameras).items():
        inside = torch.stack([in_view(points, camera) for camera in read])
        found[name] = float(inside.any(0).double().mean()), float(inside.any(1).double().mean())
    return found


CHECK = Check(
    "conventions",
    "whether poses fit images and points better under another convention",
    find,
    discredits=("points",),  # which misread poses put into wrong images
)
