"""Scenes on which both programs train alike: the same 8-bit pictures, cameras and points, in folders that both read."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, View, ViewSet
from heatsplat.datamodules.formats.colmap import write_model
from heatsplat.geometry.neighbours import neighbour_distances
from heatsplat.geometry.trajectories import orbit
from heatsplat.io.pictures import write_png
from heatsplat.renderers import rasterization

IMAGES, HELD_OUT = "images", "test.txt"
OFF_CENTRE = 0.01  # pixels


@dataclass(frozen=True)
class SharedScene:
    """A scene as it lies on the disk.

    Args:
        folder: all views, where heatsplat trains; test.txt in it names those that are held out.
        peer_folder: the training views alone, for a program that knows no split.
        modality: "thermal", whose pictures are grey, or "rgb".
        cameras: of the held-out views.
        images: theirs, [H, W, C] in [0, 1] as the pictures hold them; C = 1 for grey.
        first: camera of the first training view.
        points: [P, 3], from which both start.
    """

    folder: Path
    peer_folder: Path
    modality: str
    cameras: tuple[Camera, ...]
    images: tuple[Tensor, ...]
    first: Camera
    points: Tensor


def shared(scene: SceneData, folder: Path) -> SharedScene:
    """The scene, written below ``folder``.

    Raises:
        SceneError: the principal point of a camera is not the centre of its image, which OpenSplat takes it to be, or a
            view has a mask.
    """
    modality = "thermal" if scene.train[0].thermal is not None else "rgb"
    pictures: dict[str, tuple[Camera, np.ndarray]] = {}
    names: dict[str, list[str]] = {"train": [], "test": []}
    for subset, views in (("train", scene.train), ("test", scene.test)):
        for view in views:
            _check(view)
            name = f"{len(pictures):04d}.png"
            names[subset].append(name)
            levels = (255 * view.image(modality).clamp(0, 1)).round().to(torch.uint8).numpy()
            pictures[name] = view.camera, np.broadcast_to(levels, (*levels.shape[:2], 3))
    colors = np.full((len(scene.points), 3), 128, np.uint8)
    if scene.point_colors is not None:
        colors = (255 * scene.point_colors).round().to(torch.uint8).numpy()
    for place, chosen in (("all", pictures), ("training", names["train"])):
        cameras = [pictures[name][0] for name in chosen]
        write_model(
            folder / place / "sparse" / "0",
            {name: camera.viewmat.numpy() for name, camera in zip(chosen, cameras, strict=True)},
            [("PINHOLE", (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]), c.width, c.height) for c in cameras],
            scene.points.numpy(),
            colors,
            camera_of={name: i for i, name in enumerate(chosen)},
        )
        for name in chosen:
            write_png(folder / place / IMAGES / name, pictures[name][1])
    (folder / "all" / HELD_OUT).write_text("\n".join(names["test"]) + "\n")
    channels = 1 if modality == "thermal" else 3
    return SharedScene(
        folder / "all",
        folder / "training",
        modality,
        tuple(pictures[name][0] for name in names["test"]),
        tuple(torch.from_numpy(pictures[name][1][..., :channels] / np.float32(255)) for name in names["test"]),
        scene.train[0].camera,
        scene.points,
    )


def _check(view: View) -> None:
    camera = view.camera
    away = camera.K[:2, 2] - torch.tensor([camera.width, camera.height], dtype=torch.float64) / 2
    if away.abs().max() > OFF_CENTRE:
        raise SceneError(
            f"view {view.frame.name}: the principal point lies {away.abs().max():.2f} pixels off the centre of the image, "
            "where OpenSplat takes it to be; give a scene whose images were undistorted about their centre"
        )
    if view.mask is not None:
        raise SceneError(
            f"view {view.frame.name} has a mask, which the two programs treat differently; give another scene"
        )


class PointScene:
    """Views all around a cloud of real points, each of which is made a Gaussian of its colour; as a data module has one.

    There is no detail that a camera saw, but the clutter, density and depths are those of the real scene. Training starts
    from a draw of the points.

    Args:
        file: npz with means3d [P, 3], colors [P, 3] uint8, viewmats [V, 4, 4], Ks [V, 3, 3], width and height.
        views: on a circle through where the cameras of the file stand; every eighth is held out.
        downscale: factor by which images are smaller than the file says.
        count: points from which training starts.
        opacity: of the Gaussians that are shown.
        seed: of the draw.

    Raises:
        SceneError: there is no such file.
    """

    def __init__(
        self, file: str, views: int = 48, downscale: int = 2, count: int = 10_000, opacity: float = 0.9, seed: int = 0
    ) -> None:
        self.file, self.views, self.downscale = Path(file), views, downscale
        self.count, self.opacity, self.seed = count, opacity, seed

    @cached_property
    def scene(self) -> SceneData:
        """The rendered views, and the points that training starts from."""
        if not self.file.is_file():
            raise SceneError(f"there is no file of points {self.file}; leave its scene out with study.scenes.NAME=null")
        stored = np.load(self.file)
        points = torch.from_numpy(stored["means3d"]).float()
        colors = torch.from_numpy(stored["colors"]).float() / 255
        width, height = (int(stored[side]) // self.downscale for side in ("width", "height"))
        cameras = []
        for viewmat, K in zip(stored["viewmats"], stored["Ks"], strict=True):
            fx, fy = K[0, 0] / self.downscale, K[1, 1] / self.downscale
            centred = torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
            cameras.append(Camera(torch.from_numpy(viewmat), centred, width, height))
        cameras = orbit(cameras, self.views)
        size = neighbour_distances(points).square().mean(1).sqrt()
        size = size.clamp(max=size.median())  # points that stand alone are no fog
        cloud = (
            points,
            torch.tensor([1.0, 0, 0, 0]).expand(len(points), 4),
            size[:, None].expand(-1, 3),
            torch.full((len(points),), self.opacity),
            colors,
        )
        images = []
        for camera in cameras:
            seen = rasterization(*cloud, camera.viewmat, camera.K, width, height, backend="cpu", depth=False)
            images.append(seen.features.clamp(0, 1))
        frames = [Frame(f"{i:03d}", i, camera) for i, camera in enumerate(cameras)]
        views = ViewSet(frames, lambda i: View(frames[i], rgb=images[i]))
        held_out = range(0, self.views, 8)
        train = views.subset([i for i in range(self.views) if i not in held_out])
        test = views.subset(held_out)
        generator = torch.Generator().manual_seed(self.seed)
        drawn = torch.randperm(len(points), generator=generator)[: self.count].sort().values
        return SceneData(self.file.stem, train, test, test, points[drawn], colors[drawn])
