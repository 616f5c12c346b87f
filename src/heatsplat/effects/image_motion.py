"""Whether images are displaced along their own motion: by how many seconds, for all rows and from row to row."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from heatsplat.effects.observations import Observations, Tracks, between, slopes
from heatsplat.geometry.motion import screen_velocity, twists
from heatsplat.geometry.projection import to_camera
from heatsplat.physics.noise import MAD_TO_SIGMA

PLACED_PX = 0.2  # how well a point's place in an image is known
OUTLIER = 5.0  # usual residuals away from which an observation counts nothing (Tukey's weights)
ROUNDS = 6
FAST = 0.9  # quantile of speeds that counts as fast
SURE = 5.0  # standard errors that an estimate has to be away from zero
WIDE_PX = 0.25  # displacements that are smaller in fast images are as good as none
LONGEST_S = 0.1  # what takes longer is none of a detector: it is the scene that changes


@dataclass(frozen=True)
class Delays:
    """By how long images are late, to first order in their motion.

    Args:
        seconds: [2] of all rows alike, and of the last row against the first.
        errors: [2] their standard errors; points, and frames, err together.
        fast_px_s: speed of the image that a tenth of the observations exceed.
        velocities: [P, F, 2] of points in the image, in pixels per second.
        rows: [P, F] where points are in the image, from -1/2 at its top to 1/2.
    """

    seconds: Tensor
    errors: Tensor
    fast_px_s: float
    velocities: Tensor
    rows: Tensor

    @property
    def pixels(self) -> Tensor:
        """[2] by how much fast points are displaced: wherever they are, and in the last row."""
        return self.seconds * self.seconds.new_tensor([1.0, 0.5]) * self.fast_px_s

    @property
    def sure(self) -> Tensor:
        """[2] whether they stand out of their errors, and a detector may take as long."""
        return (self.seconds.abs() > SURE * self.errors) & (self.seconds.abs() < LONGEST_S)

    def undone(self, obs: Observations) -> Tracks:
        """The tracks without the delays; the same where these are none or too small to matter.

        Rows are read where they are displaced to. A lag τ dy/dt = x - y is undone by its own equation: x = y - τ v·∇y, since
        an image that moves changes by -v·∇y at a pixel.
        """
        seconds = torch.where(self.sure & (self.pixels.abs() > WIDE_PX), self.seconds, 0.0)
        if not seconds.any():
            return obs.tracks
        height, width = obs.images.shape[1:]
        size = self.velocities.new_tensor([width, height])
        positions = obs.tracks.positions + self.velocities * (2.0 * seconds[1] * self.rows[..., None] / size)
        values = []
        for f in range(len(obs.images)):
            image = obs.images[f].double()
            value = between(image[..., None], positions[:, f])[:, 0]
            values.append(value - seconds[0] * (slopes(image, positions[:, f]) * self.velocities[:, f]).sum(1))
        return replace(obs.tracks, values=torch.stack(values, 1))


def delays(obs: Observations) -> Delays | None:
    """What the tracks of points say; None where they say nothing.

    A point whose image moves by v and is late by d shows at its place p what lies at p + v d: its value there is off by
    d v·∇I. Beside that each point has a level, and each frame. Rows are counted from the middle of the image, from -1/2 to
    1/2, and what is read later is displaced the other way.
    """
    tracks = obs.tracks
    if tracks is None or obs.still or "time" not in obs.scene.metadata:
        return None
    record = sorted(obs.scene.train.frames, key=lambda frame: frame.time_s)
    turning = twists(
        torch.stack([frame.camera.viewmat for frame in record]),
        torch.tensor([frame.time_s for frame in record], dtype=torch.float64),
    )
    turning = dict(zip([frame.frame_id for frame in record], turning, strict=True))
    height, width = obs.images.shape[1:]
    velocities, rows, columns = [], [], []
    for f, (frame, image) in enumerate(zip(obs.frames, obs.images, strict=True)):
        position = tracks.positions[:, f]
        pixels = 0.5 * (position + 1.0) * position.new_tensor([width, height])
        nearness = 1.0 / to_camera(tracks.points, frame.camera.viewmat)[:, 2].clamp_min(1e-9)
        velocities.append(screen_velocity(pixels, nearness, frame.camera.K, turning[frame.frame_id]))
        rows.append(0.5 * position[:, 1])
        columns.append((slopes(image.double(), position) * velocities[-1]).sum(1))
    velocities, rows, columns = (torch.stack(found, 1) for found in (velocities, rows, columns))
    fast = velocities.norm(dim=2)[tracks.weights > 0].quantile(FAST)
    found = _fitted(obs, torch.stack([columns, -rows * columns], 2))
    return None if found is None else Delays(*found, float(fast), velocities, rows)


def _fitted(obs: Observations, columns: Tensor) -> tuple[Tensor, Tensor] | None:
    """What the values have of the columns [P, F, 2], and its standard errors, by robust least squares beside a level for
    each point and each frame; None where the columns are alike."""
    tracks = obs.tracks
    errors = torch.sqrt(obs.noise**2 + (PLACED_PX * tracks.slopes) ** 2)
    seen = tracks.weights > 0
    weights = tracks.weights / errors**2
    everything = torch.cat([tracks.values[..., None], columns], 2)
    for _ in range(ROUNDS):
        values, about = centred(everything, weights).split([1, 2], dim=2)
        inner = torch.einsum("pf,pfi,pfj->ij", weights, about, about)
        if not bool(torch.linalg.matrix_rank(inner) == 2):
            return None
        seconds = torch.linalg.solve(inner, torch.einsum("pf,pfi,pf->i", weights, about, values[..., 0]))
        left = values[..., 0] - about @ seconds
        usual = MAD_TO_SIGMA * (left.abs() / errors)[seen].median().clamp_min(1e-9)
        weights = (1.0 - (left / (OUTLIER * usual * errors)) ** 2).clamp_min(0.0) ** 2 * tracks.weights / errors**2
    pulls = (weights * left)[..., None] * about
    inverse = torch.linalg.inv(inner)
    variances = [(inverse @ (g.T @ g) @ inverse).diagonal() for g in (pulls.sum(0), pulls.sum(1))]
    return seconds, torch.maximum(*variances).sqrt()


def centred(values: Tensor, weights: Tensor) -> Tensor:
    """Values [P, F, c] without the mean of each point, and of each frame."""
    for _ in range(3):
        for axis in (0, 1):
            mean = (weights[..., None] * values).sum(axis, keepdim=True)
            values = values - mean / weights.sum(axis, keepdim=True)[..., None].clamp_min(1e-12)
    return values
