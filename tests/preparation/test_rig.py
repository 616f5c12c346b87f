"""A thermal camera beside a visible one."""

import numpy as np
import pycolmap
import pytest
import torch

from benchmarks.camera_folder import Field, flight, write_camera
from heatsplat.datamodules.formats.colmap import pose_matrix, read_model, write_model
from heatsplat.datamodules.synthetic_scene.film import Size
from heatsplat.geometry.alignment import Similarity, pose_errors
from heatsplat.preparation.features import Sift
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.poses import FindPoses
from heatsplat.preparation.rig import thermal_only


def test_the_thermal_model_has_the_thermal_images_alone_and_moves_with_a_similarity(tmp_path):
    viewmats = {name: np.eye(4) for name in ("thermal/a.png", "thermal/b.png", "rgb/a.png")}
    viewmats["thermal/b.png"][:3, 3] = [-1.0, 0.0, 2.0]
    lens = ("PINHOLE", (50.0, 50.0, 32.0, 26.0), 64, 52)
    write_model(tmp_path, viewmats, [lens], np.array([[0.0, 0.0, 5.0]]), np.zeros((1, 3), np.uint8))
    model, names = pycolmap.Reconstruction(str(tmp_path)), {"thermal/a.png": "a.tiff", "thermal/b.png": "b.tiff"}

    def centers(**options):
        kept = thermal_only(model, names, **options)
        poses = {image.name: pose_matrix(image) for image in kept.images.values()}
        return {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in poses.items()}, kept

    still, kept = centers()
    assert sorted(still) == ["a.tiff", "b.tiff"] and kept.num_points3D() == 1
    np.testing.assert_allclose(still["b.tiff"], [1.0, 0.0, -2.0])
    shift = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    moved = Similarity(torch.tensor(2.0, dtype=torch.float64), torch.eye(3, dtype=torch.float64), shift)
    for name, center in centers(moved=moved)[0].items():
        np.testing.assert_allclose(center, 2.0 * still[name] + [3.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.slow
def test_photos_place_the_thermal_camera_that_is_turned_against_the_visible_one(tmp_path):
    recording = flight(Size(320, 256, 24, 200), duration_s=120.0)
    field = Field((47.0, 9.0, 500.0), 0.5, drift_k=0.08, dead_pixels=40, rgb=True, rgb_offset_m=(-0.4, 0.1, 0.0))
    write_camera(recording, tmp_path / "source", field)
    frames = read_recording(tmp_path / "source", Reading()).frames
    (tmp_path / "target" / "images").mkdir(parents=True)
    for frame in frames:
        (tmp_path / "target" / "images" / f"{frame.name}.tiff").symlink_to(frame.path)
    said = FindPoses(Sift(most=800), by="rgb", gps_sd_m=(0.5, 0.5))(frames, tmp_path / "target")
    errors = pose_errors(
        torch.from_numpy(np.stack(read_model(tmp_path / "target").viewmats)), torch.from_numpy(recording.viewmats)
    )
    assert said.values["registered"] == 24 and max(said.values["gps_residual_m"]) < 1.0
    assert errors.degrees.median() < 0.5 and errors.percent.median() < 0.5
    assert float(errors.similarity.scale) == pytest.approx(1.0, abs=0.02)
    turned = float(torch.tensor(field.rgb_turn_deg).norm())
    assert said.values["thermal_from_rgb"]["degrees"] == pytest.approx(turned, abs=0.15)
