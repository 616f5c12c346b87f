"""What names of metrics.json are in words, with their units, for people who read the report.

A name that is not here is told by itself: its underscores are spaces and its suffix the unit (``io.quantities.words_and_unit``).
"""

from __future__ import annotations

from collections.abc import Mapping

Words = Mapping[str, tuple[str, str]]  # name -> (words, unit); "" for no unit, "%" for a share from 0 to 1

COST_WORDS: Words = {
    "choosing_seconds": ("choosing effects", "s"),
    "train_seconds": ("training", "s"),
    "cpu_seconds": ("processor time of it", "s"),
    "steps_per_second": ("steps per second", ""),
    "render_fps": ("frames per second", ""),
    "peak_memory_mb": ("largest memory", "MB"),
    "gaussians": ("Gaussians", ""),
    "warmup_seconds": ("warm-up", "s"),
    "evaluation_seconds": ("validation", "s"),
    "wall_seconds": ("first to last step", "s"),
}

DATA_WORDS: Words = {
    "views": ("images", ""),
    "image_sizes": ("size of the images in training", "pixels"),
    "image_size": ("size of the images as stored", "pixels"),
    "grid": ("size of the images after shrinking", "pixels"),
    "downscale": ("images are shrunk by", ""),
    "seconds": ("length of the record", "s"),
    "points": ("points of the scene", ""),
    "thermal_range_c": ("temperatures that an image can hold", "°C"),
    "training_images_c": ("temperatures in the training images", "°C"),
    "ambient_c": ("temperature of the surroundings", "°C"),
    "metres_per_unit": ("length of a unit of the scene", "m"),
    "noise_k": ("noise of the camera", "K"),
    "bits": ("bits of a pixel", ""),
    "pose_error_px": ("error of the poses", "pixels"),
    "effects": ("effects in the scene", ""),
    "probes": ("points whose temperature is known", ""),
    "split": ("test images are chosen by", ""),
    "every": ("images taken for training", ""),
    "split_in_both": ("images in training and test", ""),
    "val_views": ("validation images", ""),
    "pixel_type": ("numbers in the image files", ""),
    "channels": ("channels of the image files", ""),
    "clipped_fraction": ("pixels beyond these temperatures", "%"),
    "masked_fraction": ("pixels that do not count", "%"),
    "test_pixels_counted": ("pixels of the test images that count", "%"),
    "test_pixels_saturated": ("pixels of the test images at the camera's ends", "%"),
    "utc_at_zero_s": ("time at second 0", ""),
    "clock_at_zero_s": ("camera's clock at second 0", ""),
    "prepared_uncertainty_c": ("uncertainty of the temperatures, by preparation", "°C"),
}

RUN_WORDS: Words = {
    "modality": ("images that are learned", ""),
    "steps": ("training steps", ""),
    "thermal_model": ("thermal model", ""),
    "multiply_adds_per_gaussian": ("multiply-adds of the thermal model for each Gaussian in an image", ""),
    "parameters": ("learned numbers", ""),
    "device": ("computed on", ""),
    "averaged_updates": ("updates that the final weights average", ""),
    # cameras that were learned, or looked at
    "cameras": ("corrections of the cameras, root mean square", ""),
    "turned_px": ("turned by", "pixels"),
    "moved_px": ("moved by", "pixels"),
    "turned_deg": ("turned by", "°"),
    "moved": ("moved by", "units of the scene"),
    "camera_check": ("cameras, looked at after training", ""),
    "error_falls": ("squared errors would fall by", "%"),
    # merging
    "merging": ("Gaussians that were merged", ""),
    "tolerance_c": ("allowed error", "°C"),
    "rms_c": ("change of the images, root mean square", "°C"),
    # an early end
    "early_stop": ("stopped early", ""),
    "at_step": ("decided at step", ""),
    "gained_percent": ("gain of the last tenth", "percent"),
    "standard_error_percent": ("its standard error", "percent"),
    "residual": ("error that is left", ""),
    "camera_noise": ("of which noise of the camera", ""),
    "why": ("because", ""),
    # a budget
    "budget": ("time that was given", ""),
    "asked_s": ("asked for", "s"),
    "clock": ("by the clock", ""),
    "calibration_s": ("spent on measuring the machine", "s"),
    "train_s": ("spent on training", "s"),
    "off_percent": ("missed by", "percent"),
    "max_gaussians": ("most Gaussians", ""),
    "schedule_done": ("of the schedule done", "%"),
    "expected_psnr_on_demo_scenes": ("PSNR to expect on demo scenes", "dB"),
    "twice_gain_db": ("gain of twice the time", "dB"),
    "twice_steps": ("steps in twice the time", ""),
    "twice": ("by the plan", ""),
}

# Names whose words stand for a fall -> those for a rise, which a value below 0 is.
RISE_WORDS = {"error_falls": "squared errors would rise by"}

# Physical effects, as headings.
EFFECT_WORDS: Mapping[str, str] = {
    "relaxation": "relaxation to the surroundings",
    "harmonic_source": "heat source",
    "semi_infinite": "massive walls and ground",
    "solar": "absorbed sunlight",
    "radiation": "long-wave radiation",
    "convection": "convection by air",
    "conduction": "heat conduction",
    "shadows": "cast shadows",
    "sky_view": "hidden sky",
    "albedo": "sunlight from the ground",
    "directional_emissivity": "emissivity by angle",
    "view_dependence": "emission by direction of view",
    "reflection": "mirrored surroundings",
    "mirrored_sky": "mirrored sky",
    "attenuation": "air that absorbs",
    "thermal_opacity": "opacity of its own in thermal images",
    "point_spread": "blur of lens and detector",
    "thermal_lag": "lag of the detector",
    "rolling_readout": "rows read one after the other",
    "fixed_pattern": "fixed pattern of the pixels",
    "vignetting": "falloff towards the corners",
    "frame_offset": "offset of each image",
    "agc": "gain of each image",
    "tone": "curve from radiation to grey value",
    "pixel_area": "pixels that average over their area",
}

# Settings of effects that are simulated.
SETTING_WORDS: Words = {
    "param": ("learned as", ""),
    "ambient": ("temperature of the surroundings", ""),
    "source": ("kind", ""),
    "frequencies": ("harmonics", ""),
    "moments": ("moments of its course", ""),
    "rates_per_span": ("rates in one length of the record", ""),
    "per_span": ("flow in one length of the record", ""),
    "per_unit": ("extinction in one unit of the scene", ""),
    "degree": ("degree of the spherical harmonics", ""),
    "depth_m": ("depth", "m"),
    "neighbours": ("neighbours of each Gaussian", ""),
    "opacities": ("opacities of each Gaussian", ""),
    "falloff": ("falloff towards the sides", ""),
    "fields": ("fields that are learned", ""),
    "a2": ("coefficient of the radius²", ""),
    "a4": ("coefficient of the radius⁴", ""),
    "tau_ms": ("time constant", "ms"),
    "poses_ahead_ms": ("poses are ahead by", "ms"),
    "readout_ms": ("from the first to the last row", "ms"),
    "width_px": ("standard deviation", "pixels"),
    "width": ("hidden units of its network", ""),
    "pieces": ("linear pieces", ""),
    "per_frame": ("learned for each image", ""),
    "frames": ("images", ""),
    "histogram": ("steps of the histogram", ""),
    "nodes": ("nodes", ""),
    "window_s": ("record before a moment that counts", "s"),
    "network_sees": ("the network sees", ""),
    "left_out": ("without", ""),
}
