"""LAS and LAZ as laspy reads them: points, temperatures, attributes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from heatsplat.contracts import ViewSet
from heatsplat.export.formats.las import Las, _shown
from heatsplat.export.place import place_of

laspy = pytest.importorskip("laspy", reason="laspy is not installed (pip install -e '.[dev]')")
pytest.importorskip("lazrs", reason="lazrs is not installed (pip install -e '.[dev]')")


@pytest.mark.parametrize("compressed", [True, False])
def test_another_library_reads_what_was_written(cooling, tmp_path, compressed):
    form = Las(compressed=compressed, least_opacity=0.0)
    form.write(cooling, tmp_path / f"a{form.suffix}")
    found = laspy.read(tmp_path / f"a{form.suffix}")
    shown = _shown(cooling)
    expected = place_of(cooling.module.scene)(cooling.seen.means)[shown]
    assert np.abs(found.xyz - expected.numpy()).max() <= 1e-4
    assert np.array_equal(found["temperature"], cooling.values[shown])
    assert np.array_equal(found["time_constant"], cooling.seen.attributes["time constant"][shown], equal_nan=True)
    assert torch.allclose(torch.tensor(np.array(found["opacity"])), cooling.seen.opacities[shown])
    colours = Las().colours(cooling)[shown.numpy()]
    assert np.abs(found.red / 65535 - colours[:, 0]).max() < 1e-4
    # First and last return of its pulse, as the format counts them; programs that take either found none.
    assert (np.array(found.return_number) == 1).all() and (np.array(found.number_of_returns) == 1).all()
    assert found.header.number_of_points_by_return[0] == len(found.points)


def test_faint_gaussians_are_left_out_and_counted(cooling, tmp_path, caplog):
    caplog.set_level("INFO", logger="heatsplat")
    form = Las(compressed=False)
    form.write(cooling, tmp_path / "a.las")
    opaque = ((cooling.seen.opacities >= 0.1) & _shown(cooling)).sum().item()
    assert len(laspy.read(tmp_path / "a.las").points) == opaque
    assert f"{opaque} of {len(cooling.seen.opacities)} Gaussians have an opacity of 0.1 or more" in caplog.text


def test_what_masks_leave_out_is_shown_by_no_view(cooling):
    module, scene = cooling.module, cooling.module.scene
    nothing = torch.zeros(scene.train[0].thermal.shape[:2], dtype=torch.bool)
    masked = ViewSet(scene.train.frames, lambda i: replace(scene.train[i], mask=nothing))
    hidden = SimpleNamespace(scene=replace(scene, train=masked), renderer=module.renderer)
    assert _shown(cooling).any() and not _shown(replace(cooling, module=hidden)).any()


def test_what_no_training_view_shows_is_left_out(cooling, tmp_path, caplog):
    caplog.set_level("INFO", logger="heatsplat")
    whole = _shown(cooling)
    means = cooling.seen.means.clone()
    one = int((cooling.seen.opacities * whole).argmax())
    means[one] *= 1000.0  # far outside, behind whatever is in front
    away = replace(cooling, seen=replace(cooling.seen, means=means))
    Las(compressed=False, least_opacity=0.0).write(away, tmp_path / "a.las")
    found = laspy.read(tmp_path / "a.las")
    assert not _shown(away)[one] and 0 < len(found.points) < len(means)
    assert np.abs(found.xyz).max() < 100.0 < means[one].abs().max()
    assert "lie elsewhere" in caplog.text
