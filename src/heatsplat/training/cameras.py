"""Where training images were taken from: as the data say, or a little beside, as the images say while the scene is learned."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, check_count, check_numbers, evenly_spread, rounded
from heatsplat.same_bits import mean

log = logging.getLogger(__name__)

FEWEST = 3  # images: of two, the common movement of all leaves nothing to learn
SIGHT_VIEWS, SIGHT_POINTS = 16, 10_000  # images and points that tell whether a world is too small to be seen
MUCH_UNSEEN = 0.05  # share of points nearer than a renderer shows, from which on the log tells
ALIGN_PX = (0.1, 0.01)  # rate in pixels of the first and of the last step in which a camera is aligned to an image


class Cameras(nn.Module):
    """Takes cameras as they are given: nothing is learned, and nothing is computed.

    Attributes:
        lr: learning rate of its parameters at the papers' length of a run; shorter runs pace it (``Optimisation.pace``).
        lr_end: factor on it at the last step, log-linear in between.
        learns: whether gradients reach cameras.
        align_steps: in which the camera of each test image is aligned to its image before that is scored.
    """

    lr: float = 0.0
    lr_end: float = 1.0
    learns: bool = False
    align_steps: int = 0

    def prepare(self, scene: SceneData) -> None:
        """Takes the cameras of the training images. Called once, before training."""
        return

    def of(self, frame: Frame, progress: float = 1.0) -> Camera:
        """The camera that took an image, as it is known after ``progress`` of the run; here the data's own."""
        return frame.camera

    def keep_apart(self) -> None:
        """Told before every step of training."""
        return

    def regularisers(self) -> dict[str, Tensor]:
        """Terms of the loss by name."""
        return {}

    def learned(self) -> dict[str, Any] | None:
        """What was learned, for metrics.json; None for nothing."""
        return None


class RefinedCameras(Cameras):
    """Learns six numbers for each training image: by what its camera was turned, and moved, from where the data have it.

    Poses of a log, of another camera or of few features are off by a pixel or more, each by an error of its own: edges blur, and
    temperatures mix across them. The gradient of an image with respect to its camera costs little beside that of the Gaussians.

    **Convention:** the numbers are pixels of the training images. A turn is about the centre of the camera, by the angle of a
    pixel, an offset by what moves the image of the middle of the scene (the median depth of its points) by a pixel; both along
    the axes of the world. What all cameras do together belongs to the scene, which would drift away from cameras that are
    not trained on: no common movement, rotation or scale of the cameras is learned, to first order.

    Cameras of test images, and of whatever else is rendered, stay as they are given. Where those of test images are off
    as well, scores tell what is wrong with them, not with the scene. ``align_steps`` then aligns each to its image first, with
    the scene as it is, as is usual for methods that learn cameras; such scores are not those of cameras that are known.

    Args:
        start: share of the run after which cameras are learned: before, there is nothing to compare images with, and what they
            learn misleads.
        weight: of the mean square of the numbers in the loss, in 1/pixel².
        lr, lr_end: learning rate in pixels per step at the papers' length of a run, and the factor on it at the last step.
        align_steps: of Adam, in which the camera of each test image is aligned; 40 reach 1.5 pixels, 100 reach 4. 0: none is.

    Raises:
        ValueError: an option is out of its range.

    Source: bundle-adjusting with the scene, BARF (Lin et al., ICCV 2021), whose evaluation aligns test cameras likewise.
    """

    learns = True

    def __init__(
        self, start: float = 0.1, weight: float = 1e-3, lr: float = 5e-3, lr_end: float = 0.01, align_steps: int = 0
    ) -> None:
        super().__init__()
        check_count("cameras.align_steps", align_steps, least=0)
        for name, value in (("start", start), ("weight", weight), ("lr", lr), ("lr_end", lr_end)):
            check_numbers(name, value)
        if not 0 <= start < 1 or min(weight, lr, lr_end) < 0:
            raise ValueError(
                "cameras need start in [0, 1), and weight, lr and lr_end of 0 or more, "
                f"got {start}, {weight}, {lr} and {lr_end}"
            )
        self.start, self.weight, self.lr, self.lr_end, self.align_steps = start, weight, lr, lr_end, align_steps
        self.moves = nn.Parameter(torch.zeros(0, 6))
        # Of the training images, in the order of ``moves``: their ids, and the radians and world units that are a pixel there.
        self.register_buffer("frame_ids", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("pixels", torch.zeros(0, 2, dtype=torch.float64))
        # What all cameras may do together (``_common``).
        self.register_buffer("common", torch.zeros(0, 0), persistent=False)
        self._known: dict[int, tuple[int, float, float]] = {}  # by frame: its row, and what a pixel is, on the CPU
        self.register_load_state_dict_post_hook(lambda cameras, _: cameras._look_up())

    def prepare(self, scene: SceneData) -> None:
        frames = scene.train.frames
        if len(frames) < FEWEST:
            raise SceneError(
                f"scene '{scene.name}' has {len(frames)} training images, and cameras are learned from {FEWEST} on: give "
                "cameras=given"
            )
        focals = torch.tensor([_focal(frame.camera) for frame in frames], dtype=torch.float64)
        self.frame_ids = torch.tensor([frame.frame_id for frame in frames])
        depths = torch.tensor(seen_depths(scene)).to(focals)
        self.pixels = torch.stack([torch.ones_like(focals), depths], 1) / focals[:, None]
        self.moves = nn.Parameter(torch.zeros(len(frames), 6))
        centres = torch.stack([frame.camera.center for frame in frames])
        self.common = _common(centres - centres.mean(0), self.pixels).float()
        self._look_up()

    def _look_up(self) -> None:
        rows = zip(self.frame_ids.tolist(), self.pixels.tolist(), strict=True)
        self._known = {frame_id: (row, *pixel) for row, (frame_id, pixel) in enumerate(rows)}

    def of(self, frame: Frame, progress: float = 1.0) -> Camera:
        """The camera that took an image. That of a training image carries a gradient to ``moves`` in its view matrix, others are
        as they are given."""
        if progress < self.start or frame.frame_id not in self._known:
            return frame.camera
        row, per_turn, per_offset = self._known[frame.frame_id]
        return _moved(frame.camera, self.moves[row].to("cpu", torch.float64), per_turn, per_offset)

    @torch.no_grad()
    def keep_apart(self) -> None:
        """Takes away what all cameras have done together; before every step of training."""
        flat = self.moves.view(-1)
        flat -= ((self.common * flat).sum(1, keepdim=True) * self.common).sum(0)

    def regularisers(self) -> dict[str, Tensor]:
        return {"cameras": self.weight * 6 * mean(self.moves.square())} if self.weight > 0 else {}

    @torch.no_grad()
    def learned(self) -> dict[str, Any]:
        """Root mean squares over the images: of turns and offsets in pixels, of turns in degrees, of offsets in world units."""
        turns, offsets = self.moves.cpu().double().view(-1, 2, 3).unbind(1)
        pixels = self.pixels.cpu()
        sizes = {
            "turned_px": turns, "moved_px": offsets,
            "turned_deg": torch.rad2deg(turns * pixels[:, :1]), "moved": offsets * pixels[:, 1:],
        }  # fmt: skip
        return {name: values.square().sum(1).mean().sqrt().item() for name, values in sizes.items()}


def aligned(camera: Camera, error: Callable[[Camera], Tensor], steps: int, depth: float) -> Camera:
    """The camera beside ``camera`` from which an image differs least, as far as so many steps of Adam go.

    Args:
        error: what the image from a camera differs by, a scalar with a gradient to the view matrix.
        depth: of what it sees, in world units.
    """
    focal = _focal(camera)
    with torch.inference_mode(False), torch.enable_grad():
        # Autograd keeps no tensors that were made in inference mode.
        camera = replace(camera, viewmat=camera.viewmat.clone(), K=camera.K.clone())
        moves = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.Adam([moves])
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = ALIGN_PX[0] * (ALIGN_PX[1] / ALIGN_PX[0]) ** (step / steps)
            (moves.grad,) = torch.autograd.grad(error(_moved(camera, moves, 1 / focal, depth / focal)), [moves])
            optimizer.step()
    return _moved(camera, moves.detach(), 1 / focal, depth / focal)


def seen_depths(scene: SceneData) -> list[float]:
    """How far away what each training camera sees lies: the median depth of the scene's points in its image. Where there are
    none, that of all others, and of a scene without points its extent."""
    depths = []
    for z in _depths(scene.train.frames, scene.points):
        depths.append(float(z.median()) if len(z) else math.nan)
    usual = torch.tensor(depths).nanmedian().item()
    if math.isnan(usual):
        usual = scene.extent
    return [usual if math.isnan(depth) else depth for depth in depths]


def check_sight(scene: SceneData, near: float) -> None:
    """Raises SceneError where most of what training images show lies nearer than is rendered, as in a world of a few
    thousandths of a unit; warns where a part does.

    Args:
        near: least camera z that is seen, in world units.
    """
    frames = [scene.train.frames[i] for i in evenly_spread(len(scene.train.frames), SIGHT_VIEWS)]
    points = scene.points[torch.tensor(evenly_spread(len(scene.points), SIGHT_POINTS))]
    depths = torch.cat(_depths(frames, points))
    share = float((depths < near).double().mean()) if len(depths) else 0.0
    if share <= MUCH_UNSEEN:
        return
    told = (
        f"training cameras of scene '{scene.name}' have {100 * share:.0f} % of its points nearer than renderer.near={near:g} "
        f"world units, where nothing is shown (in the middle they lie {rounded(float(depths.median()), 2)} away): give "
        f"renderer.near={0.01 * float(depths.median()):.0e}"
    )
    if share > 0.5:
        raise SceneError(told)
    log.warning("%s", told)


def _depths(frames: Sequence[Frame], points: Tensor) -> list[Tensor]:
    """Depths of those points that lie in the image of each frame, float64."""
    found = []
    for frame in frames:
        pixels, z = frame.camera.project(points.double())
        found.append(z[frame.camera.inside(pixels, z)])
    return found


def _focal(camera: Camera) -> float:
    """Focal length in pixels, the mean of both axes."""
    return float(camera.K[:2, :2].diagonal().mean())


def _common(centres: Tensor, pixels: Tensor) -> Tensor:
    """Movements of all cameras that leave every image as it is if the scene follows, to first order.

    Args:
        centres: [F, 3] of the cameras, about their mean.
        pixels: [F, 2], radians and world units that are a pixel.

    Returns:
        [7, 6 F], orthonormal rows in pixels (fewer where some say the same): three translations, three rotations and the scale.
    """
    count, axes = len(centres), torch.eye(3, dtype=torch.float64)
    none = torch.zeros(count, 3, dtype=torch.float64)
    ways = [(none, axis.expand(count, 3)) for axis in axes]
    ways += [(axis.expand(count, 3), torch.linalg.cross(axis.expand(count, 3), centres)) for axis in axes]
    ways += [(none, centres)]
    rows = torch.stack(
        [torch.cat([turns / pixels[:, :1], moves / pixels[:, 1:]], 1).flatten() for turns, moves in ways]
    )
    _, sizes, independent = torch.linalg.svd(
        rows / rows.norm(dim=1, keepdim=True).clamp_min(1e-300), full_matrices=False
    )
    return independent[sizes > 1e-6]


def _moved(camera: Camera, moves: Tensor, per_turn: float, per_offset: float) -> Camera:
    """A camera that is turned about its centre and moved, along the axes of the world.

    Args:
        moves: [6] in pixels: three of a turn, as axis times twice the tangent of half the angle (Cayley's form), which is the
            angle where it is small; three of an offset.
        per_turn, per_offset: radians, and world units, that are a pixel.
    """
    half, offset = 0.5 * per_turn * moves[:3], per_offset * moves[3:]
    axes = torch.eye(3, dtype=moves.dtype)
    across = torch.linalg.cross(half.expand(3, 3), axes)  # rows half × axis: its matrix, transposed
    rotation = camera.viewmat[:3, :3] @ (axes + 2.0 / (1.0 + half @ half) * (across + across @ across))
    upper = torch.cat([rotation, -(rotation @ (camera.center + offset))[:, None]], 1)
    return replace(camera, viewmat=torch.cat([upper, camera.viewmat[3:]]))
