"""NTR, the data set of NTR-Gaussian: a pair of JSON files, poses in OpenCV axes, bounds that only its code knows."""

from __future__ import annotations

from typing import Any

from heatsplat.contracts import SceneData
from heatsplat.datamodules.bounds import range_in
from heatsplat.datamodules.posed_frames import FILES, listed_frames, mesh_points
from heatsplat.datamodules.side_files import finite
from heatsplat.datamodules.surroundings import OutdoorDataModule
from heatsplat.datamodules.weather_table import utc_seconds


class NTR(OutdoorDataModule):
    """root/scene with transforms_train.json, transforms_test.json, the images they name and mesh.obj.

    Camera-to-world matrices are in OpenCV axes already, although the files look like Blender's: turning them would
    break the scene. Times are seconds. The vertices of the mesh are the points; space_features.npy holds their features.
    The data set has no weather and no classes; weather.csv (on the clock of the frames, or UTC with ``start_utc``) and
    labels.npy are read where someone has added them.

    Args:
        min_c, max_c: temperatures of black and white; no file holds them. 10 and 50 are the authors' for summer,
            their winter scenes have -20 and 20.
        ambient_c: the authors' constant, or None.
        random_points: number of points to make up where the scene has no mesh.
        metres_per_unit: scale of the world, or None when unknown.
        start_utc: date-time of the frames' second 0, or None; weather in UTC and the sun need it.
        shared: weather, site, classes and features (``OutdoorDataModule``), and options of every loader.
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
        metres_per_unit: float | None = None,
        start_utc: str | None = None,
        **shared: Any,
    ) -> None:
        super().__init__(split=split, alpha_mask=alpha_mask, **shared)
        self.bounds, _ = range_in("data.min_c and data.max_c", min_c, max_c)
        self.ambient_c = ambient_c
        self.random_points = random_points
        self.metres_per_unit = metres_per_unit
        self.start_s = 0.0 if start_utc is None else utc_seconds(start_utc, self.surroundings.zone, "data.start_utc")

    def load(self) -> SceneData:
        def is_scene(path: Any) -> bool:
            return all((path / file).is_file() for file in FILES.values())

        folder = self.scene_folder(is_scene, " and ".join(FILES.values()))

        def describe(frame: dict[str, Any], file: str) -> dict[str, Any]:
            time = frame.get("time")
            return {
                "time_s": None if time is None else self.start_s + finite(time, f"{file}: time", "a number of seconds")
            }

        frames, listed = listed_frames(self, folder, describe)
        notes = listed | {
            "time_source": "key 'time' of the JSON files, seconds",
            "bounds_source": "data.min_c and data.max_c: the data set keeps them in its code",
        }
        points, origin = mesh_points(folder, frames, self.random_points, self.seed)
        return self.finish(
            folder.name,
            frames,
            points,
            thermal_range=self.bounds,
            ambient_c=self.ambient_c,
            metres_per_unit=self.metres_per_unit,
            notes=notes | origin,
            **self.surroundings.read(folder, {}, frames),
        )
