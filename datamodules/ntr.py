"""NTR, the data set of NTR-Gaussian: a pair of JSON files, poses in OpenCV axes, bounds that only its code knows."""

from __future__ import annotations

from functools import partial
from pathlib import PurePosixPath
from typing import Any

from datamodules.base import RawFrame, SceneDataModule
from datamodules.formats.images import ImageIndex, read_image
from datamodules.formats.nerfstudio import lens_in, read_transforms, viewmat_of
from datamodules.points import obj_vertices, random_points
from heatsplat.contracts import SceneData, SceneError, ThermalRange

FILES = {"train": "transforms_train.json", "test": "transforms_test.json"}


class NTR(SceneDataModule):
    """root/scene with transforms_train.json, transforms_test.json, the images they name and mesh.obj.

    Camera-to-world matrices are in OpenCV axes already, although the files look like Blender's: turning them would
    break the scene. Times are seconds. The vertices of the mesh are the points.

    Args:
        min_c, max_c: temperatures of black and white; no file holds them. 10 and 50 are the authors' for summer,
            their winter scenes have -20 and 20.
        ambient_c: the authors' constant, or None.
        random_points: number of points to make up where the scene has no mesh.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(
        self,
        *,
        split: str = "json",
        alpha_mask: bool = True,
        min_c: float = 10.0,
        max_c: float = 50.0,
        ambient_c: float | None = 36.0,
        random_points: int = 20_000,
        **shared: Any,
    ) -> None:
        super().__init__(split=split, alpha_mask=alpha_mask, **shared)
        self.bounds = ThermalRange(min_c, max_c)
        self.ambient_c = ambient_c
        self.random_points = random_points

    def load(self) -> SceneData:
        def is_scene(path: Any) -> bool:
            return all((path / file).is_file() for file in FILES.values())

        folder = self.scene_folder(is_scene, " and ".join(FILES.values()))
        index, masks = ImageIndex(folder), ImageIndex(folder / self.masks)
        frames, missing = [], []
        for subset, file_name in FILES.items():
            transforms = read_transforms(folder / file_name)
            for frame in transforms.frames:
                path = PurePosixPath(str(frame["file_path"]))
                file = index.find(str(path)) or index.find(f"{path}.png")
                if file is None:
                    missing.append(str(path))
                    continue
                read = partial(read_image, folder / file)
                # Some frames carry their own field of view; the file's holds for the others.
                own = {"camera_angle_x": frame["FovX"]} if "FovX" in frame else {}
                frames.append(
                    RawFrame(
                        name=file,
                        viewmat=viewmat_of(transforms, frame, opengl=False),
                        lens=lens_in(transforms, {**frame, **own}, lambda read=read: read().shape[1::-1]),
                        read=read,
                        time_s=None if frame.get("time") is None else float(frame["time"]),
                        read_mask=self.mask_reader(masks, file),
                        subset=subset,
                    )
                )
        if not frames:
            raise SceneError(
                f"no frame of {folder / FILES['train']} has an image in {folder}: looked for {missing[0]}.png"
            )
        notes: dict[str, Any] = {
            "registered": len(frames) + len(missing),
            "cameras": "transforms_train.json and transforms_test.json, OpenCV axes",
            "time_source": "key 'time' of the JSON files, seconds",
            "bounds_source": "data.min_c and data.max_c: the data set keeps them in its code",
        }
        if missing:
            notes["images_missing"] = f"{len(missing)} frames have no image, dropped: {', '.join(missing[:5])}"
        mesh = folder / "mesh.obj"
        if mesh.is_file():
            points, notes["points_source"] = obj_vertices(mesh), "vertices of mesh.obj"
        else:
            points = random_points([f.viewmat for f in frames], self.random_points, self.seed)
            notes["points_source"] = f"{len(points)} random points in the cube that the cameras look at: no mesh.obj"
        return self.finish(
            folder.name,
            frames,
            points,
            thermal_range=self.bounds,
            ambient_c=self.ambient_c,
            notes=notes,
        )
