"""The loader of a protocol's scenes: it reads what was written, bit for bit where that is possible."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.benchmark import Benchmark
from heatsplat.datamodules.benchmark_folder import write_scene
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.weather_table import OF_COVER

PARTS = {"near": 8, "views": 0.12, "times": None, "weather": [[0.5, 1.0]]}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("protocol")
    scene = Synthetic(scene="outdoor", size="tiny", split="parts", parts=PARTS).scene
    # Share of light, which is another than light tells.
    cover = torch.linspace(0.0, 0.7, len(scene.weather.times_s), dtype=torch.float64)
    weather = replace(scene.weather, clouds=cover, notes={**scene.weather.notes, "clouds": OF_COVER})
    scene = replace(scene, weather=weather, point_features=scene.points.float() ** 2)
    write_scene(scene, root / "scenes" / "yard", root / "truth" / "yard", {"protocol": 1, "size": "tiny"})
    return scene, root


def test_a_scene_comes_back_as_it_was(written):
    scene, root = written
    found = Benchmark(root=str(root), scene="yard").scene
    assert found.thermal_range == scene.thermal_range and found.metres_per_unit == 1.0
    assert torch.allclose(found.points, scene.points) and torch.equal(found.labels, scene.labels)
    assert torch.equal(found.point_features, scene.point_features)
    for subset, which in (("train", "thermal"), ("test", "clean")):
        one, other = getattr(scene, subset), getattr(found, subset)
        assert [f.name.split(".")[0] for f in one.frames] == [f.name.split(".")[0] for f in other.frames]
        assert np.allclose(one.times_s, other.times_s, atol=1e-3)
        for before, after in zip(one, other, strict=True):
            assert torch.allclose(before.camera.viewmat, after.camera.viewmat, atol=1e-9)
            assert torch.allclose(before.camera.K, after.camera.K)
            assert torch.allclose(before.image(which), after.thermal, atol=2e-6)
            assert torch.allclose(before.rgb, after.rgb, atol=1e-6)
    assert {frame.name.split("_")[0] for frame in found.test.frames} == {"near", "views", "weather"}
    assert torch.allclose(found.weather.air_c, scene.weather.air_c, atol=1e-6)
    assert torch.allclose(found.weather.sun, scene.weather.sun, atol=1e-4)
    assert torch.allclose(found.weather.clouds, scene.weather.clouds, atol=1e-6)


def test_without_the_truth_nothing_is_measured(written, tmp_path):
    _, root = written
    shutil.copytree(root / "scenes", tmp_path / "scenes")
    with pytest.raises(SceneError, match="give the folder that holds them with data.truth=FOLDER"):
        Benchmark(root=str(tmp_path), scene="yard").load()
    assert len(Benchmark(root=str(tmp_path), scene="yard", truth=str(root / "truth")).load().test) > 3
    with pytest.raises(SceneError, match="data.scene=garden: there is no such scene"):
        Benchmark(root=str(root), scene="garden").load()
