"""Filming a scene with a hand-held thermal camera: the path, exact pixels, and the noise of the sensor."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from heatsplat.contracts import ThermalRange
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.synthetic_scene.paths import by_hand, swung, swung_path
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.training.rng import generator_for

# A pixel is resampled on 3 x 3 rays where it differs by this much from the mean of its neighbours, in kelvin: one ray
# is right to second order on a smooth surface, but not at an edge.
_EDGE_K = 0.05
_FIELD_OF_VIEW_DEG = 48.0
# Likewise in colour, which alone shows the edges behind glass: a quarter of a step of 8 bits.
_EDGE_COLOR = 0.25 / 255
# Colour of a source that is hot enough to be seen in the dark.
_GLOWING = (0.9, 0.35, 0.15)


@dataclass(frozen=True)
class Size:
    """How large a recording is: image size in pixels, frames, and points of its sparse model."""

    width: int
    height: int
    frames: int
    points: int


SIZES = {
    "tiny": Size(64, 52, 19, 600),
    "demo": Size(160, 128, 72, 4000),
    "benchmark": Size(320, 256, 120, 8000),
    "large": Size(640, 512, 240, 20000),
}


@dataclass(frozen=True)
class Recording:
    """What the camera brought home, and what is known besides.

    Args:
        scene: what was filmed.
        lens: intrinsics and distortion of every frame.
        viewmats: [F, 4, 4] float64 world-to-camera, OpenCV axes, metres.
        times_s: [F] float64, whole milliseconds, increasing from the start of the record.
        celsius: [F, H, W] float32 temperatures, with noise and the camera's flaws.
        rgb: [F, H, W, 3] uint8 visible images of the same camera.
        thermal_range: the scene's own, or whole degrees that enclose all noise-free temperatures with half a degree to spare.
        points: [P, 3] float64 points seen in the frames, a few millimetres off their surfaces.
        point_colors: [P, 3] in [0, 1].
        exact: [F, H, W] float32 temperatures without noise and flaws.
    """

    scene: Scene
    lens: Lens
    viewmats: np.ndarray
    times_s: np.ndarray
    celsius: np.ndarray
    rgb: np.ndarray
    thermal_range: ThermalRange
    points: np.ndarray
    point_colors: np.ndarray
    exact: np.ndarray

    @property
    def clean(self) -> np.ndarray | None:
        """``exact`` where the camera has flaws; None where it has none but noise."""
        return self.exact if self.scene.preset.flaws else None

    def shows(self, frame: int, surface: str) -> np.ndarray:
        """Which pixels [H, W] of a frame's thermal image show a surface: those whose central ray meets it first."""
        number = [one.name for one in self.scene.preset.surfaces].index(surface)
        rays = pixel_rays(self.lens, pixel_centres(self.lens))
        _, which = hits(self.scene, torch.from_numpy(self.viewmats[frame]), rays)
        return (which == number).reshape(self.lens.height, self.lens.width).numpy()

    def grey(self, frame: int, dtype: type = np.uint8) -> np.ndarray:
        """Stored image [H, W] of a frame: ``thermal_range`` over the whole of an integer type, rounded and clipped."""
        full = np.iinfo(dtype).max
        unit = self.thermal_range.to_unit(self.celsius[frame].astype(np.float64))
        return np.clip(np.rint(unit * full), 0, full).astype(dtype)


def film(
    scene: Scene,
    size: Size,
    seed: int = 0,
    noise_k: float = 0.05,
    distortion: Sequence[float] = (),
    pixel_aspect: float = 1.0,
) -> Recording:
    """A recording of ``scene``; the same arguments give the same bits.

    Args:
        scene: what to film.
        size: images, frames and points.
        seed: of the hand's motion, the noise and the choice of points.
        noise_k: standard deviation of the noise of a pixel (NETD) in kelvin; 0 for clean images.
        distortion: k1 k2 p1 p2 of OpenCV's model, or nothing for a pinhole.
        pixel_aspect: fy / fx.
    """
    lens = _lens(size, distortion, pixel_aspect)
    swings = scene.preset.video_hz is not None
    times, viewmats = (scene.route or partial(swung if swings else by_hand, scene.preset))(size.frames, seed)
    rays = pixel_rays(lens, pixel_centres(lens))
    exact = np.empty((size.frames, size.height, size.width), dtype=np.float32)
    celsius = np.empty_like(exact)
    rgb = np.empty((size.frames, size.height, size.width, 3), dtype=np.uint8)
    lows, highs = np.empty(size.frames), np.empty(size.frames)
    flaws = scene.preset.flaws

    def shoot(frame: int) -> None:
        temperature, color = expose(scene, lens, rays, viewmats[frame], float(times[frame]))
        lows[frame], highs[frame] = temperature.min().item(), temperature.max().item()
        exact[frame] = temperature.numpy()
        if noise_k and not flaws:
            temperature = temperature + _noise(noise_k, temperature, seed, frame)
        celsius[frame] = temperature.numpy()
        rgb[frame] = (color * 255.0).round().to(torch.uint8).numpy()

    def see(moments: Sequence[float]) -> Iterator[Tensor]:
        poses = swung_path(torch.tensor(moments, dtype=torch.float64), seed)
        return pool.map(lambda pose, at: expose(scene, lens, rays, pose, at)[0], poses, moments)

    with own_threads() as threads, ThreadPoolExecutor(threads) as pool:
        list(pool.map(shoot, range(size.frames)))
        read = flaws.detector.images(see, times, size.height) if flaws and flaws.detector else None
        count = max(round(size.points / scene.preset.sparseness), 16)
        points, colors = sparse_points(scene, lens, viewmats, count, seed)
    enclosing = ThermalRange(math.floor(lows.min() - 0.5), math.ceil(highs.max() + 0.5))
    thermal_range = scene.thermal_range or enclosing
    if flaws:
        read = torch.from_numpy(exact).double() if read is None else read
        recorded = thermal_range.to_celsius(flaws.record(thermal_range.to_unit(read), seed))
        if noise_k:
            recorded = recorded + torch.stack([_noise(noise_k, one, seed, i) for i, one in enumerate(recorded)])
        celsius = recorded.float().numpy()
    return Recording(
        scene=scene,
        lens=lens,
        viewmats=viewmats.numpy(),
        times_s=times,
        celsius=celsius,
        rgb=rgb,
        thermal_range=thermal_range,
        points=points.numpy(),
        point_colors=colors.numpy(),
        exact=exact,
    )


def _noise(noise_k: float, image: Tensor, seed: int, frame: int) -> Tensor:
    return noise_k * torch.randn(image.shape, generator=generator_for(seed, frame, "camera noise"))


@contextmanager
def own_threads() -> Iterator[int]:
    """Turns torch's threads off within and gives their number, to be used for whole frames.

    Its threads wait for each other after every small operation, which made filming ten times slower on a busy machine.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)


def _lens(size: Size, distortion: Sequence[float], pixel_aspect: float) -> Lens:
    focal = 0.5 * size.width / math.tan(math.radians(0.5 * _FIELD_OF_VIEW_DEG))
    return Lens(
        fx=focal,
        fy=focal * pixel_aspect,
        cx=0.5 * size.width,
        cy=0.5 * size.height,
        width=size.width,
        height=size.height,
        distortion=tuple(distortion),
        model="OPENCV" if distortion else "PINHOLE",
    )


def misplaced(recording: Recording, error_px: float, seed: int) -> np.ndarray:
    """World-to-camera matrices [F, 4, 4] as structure from motion gives them: turned by so many pixels along each side of the
    image, standard deviation."""
    if not error_px:
        return recording.viewmats
    lens, count = recording.lens, len(recording.viewmats)
    drawn = torch.randn(count, 2, generator=generator_for(seed, 0, "pose error"), dtype=torch.float64).numpy()
    turns = np.zeros((count, 3))
    turns[:, 0], turns[:, 1] = error_px / lens.fy * drawn[:, 0], error_px / lens.fx * drawn[:, 1]
    wrong = recording.viewmats.copy()
    wrong[:, :3] = Rotation.from_rotvec(turns).as_matrix() @ wrong[:, :3]
    return wrong


def pixel_centres(lens: Lens) -> Tensor:
    """Pixel positions [H * W, 2] (x, y), row by row."""
    y, x = torch.meshgrid(
        torch.arange(lens.height, dtype=torch.float64), torch.arange(lens.width, dtype=torch.float64), indexing="ij"
    )
    return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5


def pixel_rays(lens: Lens, pixels: Tensor) -> Tensor:
    """Directions [n, 3] in camera axes, z = 1, of the rays that a lens brings to ``pixels`` [n, 2].

    Distortion is inverted by Newton's method on the distorted position; its polynomial is OpenCV's
    (docs.opencv.org, "Camera Calibration and 3D Reconstruction").
    """
    target = (pixels - pixels.new_tensor([lens.cx, lens.cy])) / pixels.new_tensor([lens.fx, lens.fy])
    x, y = target[:, 0], target[:, 1]
    if lens.distortion:
        k1, k2, p1, p2 = lens.distortion
        for _ in range(12):
            r2 = x * x + y * y
            radial, slope = 1 + r2 * (k1 + k2 * r2), k1 + 2 * k2 * r2
            error_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - target[:, 0]
            error_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - target[:, 1]
            xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            determinant = xx * yy - xy * xy
            x, y = x - (yy * error_x - xy * error_y) / determinant, y - (xx * error_y - xy * error_x) / determinant
    return torch.stack([x, y, torch.ones_like(x)], dim=1)


def expose(scene: Scene, lens: Lens, rays: Tensor, viewmat: Tensor, time_s: float) -> tuple[Tensor, Tensor]:
    """Temperatures [H, W] in °C, float64, and colours [H, W, 3] in [0, 1] that a noise-free camera would record.

    Args:
        rays: [H * W, 3] what ``pixel_rays`` returns for the pixel centres of ``lens``.
        viewmat: [4, 4] world-to-camera.
        time_s: seconds from the start of the record.
    """
    when = torch.tensor([time_s], dtype=torch.float64)
    haze = scene.preset.haze

    def look(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        points, which = hits(scene, viewmat, directions)
        parts = scene.parts(points, which)
        color = scene.visible(points, which, directions @ viewmat[:3, :3], parts)
        celsius = scene.celsius(scene.heat_at(points, which, parts), when)[:, 0]
        sight = torch.nn.functional.normalize(directions @ viewmat[:3, :3], dim=1)
        celsius = scene.apparent(celsius, points, which, sight, time_s)
        if haze:
            distance = (points @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
            ambient = scene.preset.ambient_c
            share = haze.transmission(distance, time_s / scene.preset.duration_s)
            celsius = ambient + (celsius - ambient) * share
        center = -(viewmat[:3, :3].T @ viewmat[:3, 3])[None]
        hot = scene.in_front(center, directions @ viewmat[:3, :3], points, which, time_s)
        if hot.any():
            celsius[hot], color[hot] = scene.preset.carried.celsius, color.new_tensor(_GLOWING)
        return celsius, color, scene.transmits[which] > 0

    celsius, color, clear = look(rays)
    edges = _stands_out(celsius[:, None], lens) > _EDGE_K
    if clear.any():
        edges |= clear & (_stands_out(color, lens) > _EDGE_COLOR)
    edges = edges.nonzero()[:, 0]
    third = torch.tensor([-1 / 3, 0.0, 1 / 3], dtype=torch.float64)
    within = torch.cartesian_prod(third, third)
    fine_celsius, fine_color, _ = look(pixel_rays(lens, (pixel_centres(lens)[edges, None] + within).reshape(-1, 2)))
    celsius[edges] = fine_celsius.reshape(-1, len(within)).mean(1)
    color[edges] = fine_color.reshape(-1, len(within), 3).mean(1)
    return celsius.reshape(lens.height, lens.width), color.reshape(lens.height, lens.width, 3)


def _stands_out(values: Tensor, lens: Lens) -> Tensor:
    """How far the pixels of ``values`` [H * W, C] differ from the mean of their neighbours, in any channel, [H * W]."""
    image = values.T.reshape(1, -1, lens.height, lens.width)
    around = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return (image - around).abs().amax(1).reshape(-1)


def hits(scene: Scene, viewmat: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """First points [n, 3] on the rays ``directions`` [n, 3] (camera axes), and their surfaces [n] (-1: none)."""
    rotation = viewmat[:3, :3]
    return scene.first_hits(-(rotation.T @ viewmat[:3, 3])[None], directions @ rotation)


def sparse_points(scene: Scene, lens: Lens, viewmats: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points [P, 3] and colours [P, 3] such as structure from motion finds: seen in frames, a little off their surface.

    Where light passes a surface, every other point is one that thermal images show and the next lies behind it.
    """
    generator = generator_for(seed, 0, "sparse points")
    frames = torch.randint(len(viewmats), (count,), generator=generator)
    extent = torch.tensor([lens.width, lens.height], dtype=torch.float64)
    rays = pixel_rays(lens, torch.rand(count, 2, generator=generator, dtype=torch.float64) * extent)
    points, which = torch.empty(count, 3, dtype=torch.float64), torch.full((count,), -1)
    odd = torch.arange(count) % 2 == 1
    for frame in frames.unique().tolist():
        here = frames == frame
        points[here], which[here] = hits(scene, viewmats[frame], rays[here])
        passing = here & (scene.transmits[which] > 0) & odd
        if passing.any():
            points[passing], which[passing] = scene.beyond(points[passing], rays[passing] @ viewmats[frame][:3, :3])
    bare = [i for i, one in enumerate(scene.preset.surfaces) if one.name in scene.preset.bare]
    found = (which >= 0) & ~torch.isin(which, torch.tensor(bare, dtype=which.dtype))
    colors = scene.color(points, which)[found]
    noise = scene.preset.point_noise_m * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return (points + noise)[found], colors
