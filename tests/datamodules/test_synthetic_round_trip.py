"""The synthetic scene written in every layout and read back by that layout's loader."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from scene_files import APPLIED_TRANSFORM, LAYOUTS, PALETTE, clock_digits, write_rhd

from heatsplat.contracts import SceneData, View
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.rgbt_scenes import RGBTScenes
from heatsplat.datamodules.rhd import RHD
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, expose, film, pixel_rays
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.thermo import Thermo
from heatsplat.datamodules.thermoscenes import ThermoScenes
from heatsplat.datamodules.ti_nsd import TINSD

SIZE = replace(SIZES["tiny"], frames=17, points=200)
DISTORTION = (-0.28, 0.07, 0.0008, -0.0005)


@cache
def scene() -> Scene:
    return Scene(PRESETS["cooling"])


@cache
def recording() -> Recording:
    return film(scene(), SIZE)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one scene "cooling" per layout: root/<layout>/cooling."""
    folder = tmp_path_factory.mktemp("layouts")
    for name, write in LAYOUTS.items():
        write(recording(), folder / name / "cooling")
    return folder


def loaded(root: Path, layout: str) -> SceneData:
    bounds = recording().thermal_range
    modules = {
        "rhd": lambda **where: RHD(**where),
        "thermoscenes": lambda **where: ThermoScenes(**where),
        "ti_nsd": lambda **where: TINSD(seconds_per_frame=0.001, **where),
        "colmap": lambda **where: Colmap(rgb="rgb", time_csv="times.csv", ambient_c=22.0, **where),
        "rgbt_scenes": lambda **where: RGBTScenes(**where),
        "ntr": lambda **where: NTR(min_c=bounds.min_c, max_c=bounds.max_c, ambient_c=22.0, **where),
        "thermo": lambda **where: Thermo(**where),
    }
    return modules[layout](root=str(root / layout), scene="cooling").scene


def views(data: SceneData) -> list[View]:
    """All views of all splits, by the frame of the recording that they show."""
    return sorted([*data.train, *data.test], key=lambda view: view.frame.frame_id)


def in_recorded_order(data: SceneData, turn: np.ndarray) -> list[View]:
    """Views in the order of the recording, matched by the positions of the cameras in the world turned by ``turn``."""
    found = views(data)
    recorded = np.linalg.inv(recording().viewmats)[:, :3, 3] @ turn[:3, :3].T
    apart = np.linalg.norm(recorded[:, None] - np.stack([v.camera.center.numpy() for v in found])[None], axis=2)
    order = apart.argmin(1)
    assert sorted(order) == list(range(len(recorded)))
    return [found[i] for i in order]


def turn_of(layout: str) -> np.ndarray:
    """What a layout does to the world."""
    return np.vstack([APPLIED_TRANSFORM, [0, 0, 0, 1.0]]) if layout == "thermoscenes" else np.eye(4)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_poses_lenses_and_points_survive(root, layout):
    data, turn = loaded(root, layout), turn_of(layout)
    for frame, view in enumerate(in_recorded_order(data, turn)):
        expected = recording().viewmats[frame] @ np.linalg.inv(turn)
        assert np.abs(view.camera.viewmat.numpy() - expected).max() < 1e-6
        assert np.abs(view.camera.K.numpy() - recording().lens.matrix()).max() < 1e-6 * recording().lens.fx
        assert (view.camera.width, view.camera.height) == (64, 52)
    points = recording().points @ turn[:3, :3].T
    by_place = data.points.double().numpy()
    order = np.linalg.norm(points[:, None] - by_place[None], axis=2).argmin(1)
    assert len(by_place) == len(points) and sorted(order) == list(range(len(points)))
    assert np.abs(by_place[order] - points).max() < 1e-6
    if data.point_colors is not None:
        assert np.abs(data.point_colors.numpy()[order] - recording().point_colors).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("layout", ["rhd", "thermoscenes", "colmap", "ntr", "thermo"])
def test_temperatures_survive_to_half_a_grey_level(root, layout):
    data = loaded(root, layout)
    assert data.thermal_range == recording().thermal_range
    half = 0.5 * data.thermal_range.span_k / 255
    for frame, view in enumerate(in_recorded_order(data, turn_of(layout))):
        celsius = data.thermal_range.to_celsius(view.thermal[..., 0].double().numpy())
        assert view.thermal.shape == (52, 64, 1) and view.mask is None
        assert np.abs(celsius - recording().celsius[frame]).max() <= half * 1.001


def test_sixteen_bit_counts_survive_to_half_a_count(root):
    module = Colmap(root=str(root / "colmap"), scene="cooling", raw="raw16", time_csv="times.csv")
    for frame, view in enumerate(in_recorded_order(module.scene, np.eye(4))):
        celsius = module.scene.thermal_range.to_celsius(view.thermal[..., 0].double().numpy())
        assert np.abs(celsius - recording().celsius[frame]).max() <= 0.5 / 64 * 1.01  # float32 on top


def test_display_intensities_survive_without_temperatures(root):
    data = loaded(root, "ti_nsd")
    assert data.thermal_range is None
    for frame, view in enumerate(in_recorded_order(data, np.eye(4))):
        unit = recording().thermal_range.to_unit(recording().celsius[frame])
        assert np.abs(view.thermal[..., 0].numpy() - unit).max() <= 0.5 / 255 * 1.001


def test_pseudo_colour_survives_and_is_no_temperature(root):
    data = loaded(root, "rgbt_scenes")
    assert data.thermal_range is None and "time" not in data.metadata
    palette = colormaps[PALETTE](np.arange(256))[:, :3]
    for frame, view in enumerate(in_recorded_order(data, np.eye(4))):
        assert view.thermal.shape == (52, 64, 3)
        expected = palette[recording().grey(frame)]
        assert np.abs(view.thermal.numpy() - expected).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("layout", ["rhd", "ti_nsd", "colmap", "ntr", "thermo"])
def test_times_survive_to_the_millisecond(root, layout):
    data = loaded(root, layout)
    recorded = recording().times_s
    found = np.array([view.time_s for view in in_recorded_order(data, np.eye(4))])
    assert np.abs((found - found[0]) - (recorded - recorded[0])).max() < 1e-9 * 86400
    assert min(data.train.times_s) == 0.0


def test_recording_past_midnight_keeps_its_times(tmp_path):
    write_rhd(recording(), tmp_path / "cooling", clock_s=24 * 3600 - 900.0)
    names = sorted(path.name for path in (tmp_path / "cooling" / "thermal" / "images").iterdir())
    assert names[0].startswith("00") and names[-1].startswith("23")
    data = RHD(root=str(tmp_path), scene="cooling").scene
    found = np.array([view.time_s for view in in_recorded_order(data, np.eye(4))])
    assert np.abs((found - found[0]) - (recording().times_s - recording().times_s[0])).max() < 1e-9 * 86400


@pytest.mark.parametrize("layout", ["thermoscenes", "colmap", "rgbt_scenes"])
def test_visible_images_survive(root, layout):
    for frame, view in enumerate(in_recorded_order(loaded(root, layout), turn_of(layout))):
        assert np.array_equal((view.rgb * 255.0).round().numpy().astype(np.uint8), recording().rgb[frame])


@pytest.mark.parametrize("layout", ["thermoscenes", "rgbt_scenes", "ntr", "ti_nsd", "colmap", "thermo"])
def test_every_eighth_frame_is_test(root, layout):
    data = loaded(root, layout)
    centers = np.linalg.inv(recording().viewmats)[:, :3, 3] @ turn_of(layout)[:3, :3].T
    test = [int(np.linalg.norm(centers - v.camera.center.numpy(), axis=1).argmin()) for v in data.test]
    assert sorted(test) == [0, 8, 16]


def test_ambient_temperature_survives(root):
    assert {loaded(root, layout).ambient_c for layout in ("rhd", "ntr", "thermo")} == {22.0}


def test_distorted_images_are_straightened(tmp_path):
    """Written through a real lens and read back, images show what a pinhole of the loader's camera would have seen."""
    bent = film(
        scene(), replace(SIZE, width=128, height=104, frames=9), noise_k=0.0, distortion=DISTORTION, pixel_aspect=1.06
    )
    LAYOUTS["thermoscenes"](bent, tmp_path / "cooling")
    data = ThermoScenes(root=str(tmp_path), scene="cooling").scene
    half = 0.5 * data.thermal_range.span_k / 255
    turn = turn_of("thermoscenes")
    straight = replace(bent.lens, distortion=(), model="PINHOLE")
    y, x = np.mgrid[:104, :128] + 0.5
    rays = pixel_rays(straight, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
    times = {tuple(np.round(np.linalg.inv(v)[:3, 3], 6)): t for v, t in zip(bent.viewmats, bent.times_s, strict=True)}
    for view in (data.train[0], data.train[4], data.test[0]):
        assert np.abs(view.camera.K.numpy() - straight.matrix()).max() < 1e-9
        viewmat = view.camera.viewmat @ torch.from_numpy(turn)
        time = times[tuple(np.round(torch.linalg.inv(viewmat)[:3, 3].numpy(), 6))]
        expected = expose(scene(), straight, rays, viewmat, time)[0].numpy()
        error = np.abs(data.thermal_range.to_celsius(view.thermal[..., 0].double().numpy()) - expected)
        padded = np.pad(expected, 2, mode="edge")
        around = np.stack([padded[i : i + 104, j : j + 128] for i in range(5) for j in range(5)])
        valid = np.ones_like(error, dtype=bool) if view.mask is None else view.mask.numpy()
        smooth = valid & (np.ptp(around, axis=0) < 1.0)
        assert smooth.mean() > 0.15
        assert np.quantile(error[smooth], 0.99) < 2.5 * half  # two roundings and the interpolation between pixels
        # As they were stored, the same pixels are wrong by several times as much.
        frame = int(np.flatnonzero(bent.times_s == time)[0])
        stored = np.sqrt(np.mean((bent.celsius[frame] - expected)[valid] ** 2))
        assert np.sqrt(np.mean(error[valid] ** 2)) < 0.35 * stored


def test_rays_of_a_distorted_lens_arrive_where_they_came_from():
    """The forward polynomial applied to the traced rays gives the pixels back."""
    lens = replace(recording().lens, distortion=DISTORTION, fy=1.06 * recording().lens.fx)
    y, x = np.mgrid[:52, :64] + 0.5
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    u, v, _ = pixel_rays(lens, torch.from_numpy(pixels)).numpy().T
    k1, k2, p1, p2 = DISTORTION
    r2 = u * u + v * v
    bent_u = u * (1 + k1 * r2 + k2 * r2**2) + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    bent_v = v * (1 + k1 * r2 + k2 * r2**2) + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    arrived = np.stack([lens.fx * bent_u + lens.cx, lens.fy * bent_v + lens.cy], axis=1)
    assert np.abs(arrived - pixels).max() < 1e-9


def test_clock_digits_wrap_at_midnight():
    assert clock_digits(15 * 3600 + 38 * 60 + 24.825) == "153824825"
    assert clock_digits(24 * 3600 + 0.001) == "000000001"
    assert clock_digits(59.9996) == "000100000"


def test_layouts_that_cannot_hold_a_lens_say_so(tmp_path):
    with pytest.raises(ValueError, match="NTR layout knows square pixels without distortion only"):
        LAYOUTS["ntr"](replace(recording(), lens=replace(recording().lens, distortion=DISTORTION)), tmp_path)
