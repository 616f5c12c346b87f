"""SupIR-GS on the flawed camera: the fields that it finds are those of the camera, without a clean image to learn from."""

import numpy as np
import pytest
import torch
from running import run

from heatsplat.datamodules.synthetic_scene.presets import PRESETS

BRIGHTNESS = 0.35  # of the middle of the scene; gain and bias are told apart by other brightnesses only


@pytest.mark.slow
def test_fixed_pattern_and_vignetting_are_found(tmp_path):
    """Correlation 0.9 or more with the fixed pattern, and the falloff in the corners to 2 %, at a quarter of the size."""
    quiet = ("callbacks.images=null", "callbacks.probes=null", "trainer.val_check_interval=1500", "threads=2")
    module, _ = run(tmp_path, "method=supirgs", "max_steps=1500", *quiet)
    calibration, frame = module.sensor.parts["calibration"], module.scene.test.frames[0]
    height, width = frame.camera.height, frame.camera.width
    gain, bias, falloff = (field.numpy() for field in PRESETS["noisy_sensor"].flaws.fields(height, width, seed=0))
    with torch.no_grad():
        seen = calibration(torch.full((height, width, 1), BRIGHTNESS), frame)[..., 0].numpy()
        found_falloff = calibration.vignetting(height, width)[..., 0].numpy()
    pattern, truth = seen / found_falloff, BRIGHTNESS * (1 + gain) + bias
    assert np.corrcoef(pattern.ravel(), truth.ravel())[0, 1] > 0.9
    corners = np.ix_([0, -1], [0, -1])
    assert found_falloff[corners].mean() == pytest.approx(falloff[corners].mean(), rel=0.02)
