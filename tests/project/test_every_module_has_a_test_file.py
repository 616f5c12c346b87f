"""Every module has a test file that is named after it, or is on the list of those that are tested in another file.

A test file stands in tests/<package>/ and is called test_<module>.py, or test_<folder>_<module>.py where another module has that
name too.
"""

from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {name: ROOT / name for name in ("datamodules", "preparation")} | {
    path.name: path for path in (ROOT / "src" / "heatsplat").iterdir() if (path / "__init__.py").exists()
}
# Test file -> modules that it tests and that have no file of their own. This list only shrinks: a new module brings a test file.
ELSEWHERE = {
    "callbacks/test_quality_and_probes": "callbacks/images callbacks/metrics callbacks/probes callbacks/progress",
    "callbacks/test_report": "callbacks/board callbacks/statistics",
    "datamodules/test_colmap": "datamodules/points",
    "datamodules/test_damage": "datamodules/formats/colmap_records datamodules/poses",
    "datamodules/test_other_loaders": "datamodules/ntr datamodules/rgbt_scenes datamodules/ti_nsd",
    "datamodules/test_outdoor": "datamodules/synthetic_scene/outdoor_heat",
    "datamodules/test_scenes": "datamodules/base",
    "datamodules/test_synthetic": "datamodules/synthetic_scene/film datamodules/synthetic_scene/scene",
    "datamodules/test_synthetic_heat": "datamodules/synthetic_scene/heat datamodules/synthetic_scene/presets",
    "datamodules/test_synthetic_shapes": "datamodules/synthetic_scene/shapes",
    "datamodules/test_thermo": "datamodules/surroundings",
    "datamodules/test_weather": "datamodules/sun",
    "density/test_adaptive": "density/base density/fixed",
    "effects/test_catalogue": "effects/base effects/weather_record effects/physical/reflection effects/physical/relaxation",
    "effects/test_joint_fit": (
        "effects/joint/data effects/joint/evidence effects/joint/image_grid effects/joint/least_squares effects/joint/model "
        "effects/joint/selection effects/joint/terms effects/physical/fixed_pattern "
        "effects/physical/frame_offset effects/physical/tone effects/physical/view_dependence effects/physical/vignetting"
    ),
    "effects/test_masked_evidence": "effects/inspection effects/physical/point_spread",
    "effects/test_off_is_absent": "effects/physical/convection effects/physical/radiation effects/physical/solar",
    "io/test_tiff_and_pictures": "io/pictures io/tiff io/video",
    "losses/test_compose": "losses/schedules",
    "losses/test_high_frequency": "losses/swinir losses/teacher",
    "losses/test_photometric": "kernels/ssim",
    "losses/test_ravigs_terms": "losses/gradients losses/physical_prior",
    "losses/test_thermal_gaussian_terms": "losses/modality_balance losses/smoothness",
    "losses/test_thermogs_terms": "losses/edge_difference thermal/heat_terms",
    "metrics/test_image_metrics": "metrics/psnr metrics/ssim metrics/valid",
    "metrics/test_temperature_metrics": "metrics/mae metrics/mae_roi metrics/otsu metrics/scores",
    "physics/test_physics_energy_balance": "kernels/heat_balance",
    "renderers/test_contract": (
        "kernels/buffers kernels/compositing kernels/constants kernels/layout kernels/projection "
        "kernels/spherical_harmonics renderers/base renderers/cpu renderers/reference"
    ),
    "renderers/test_mip_filters": "renderers/smoothing",
    "runs/test_budget": "callbacks/budget runs/curves runs/stepping",
    "runs/test_pipeline": "runs/checks runs/folder runs/resume runs/run",
    "sensors/test_supirgs_sensor": "sensors/agc sensors/base sensors/calibration sensors/tone",
    "studies/test_frontier_study": "studies/frontier/report studies/frontier/runs",
    "studies/test_reproduction": "studies/published/comparison studies/published/sources",
    "studies/test_sweeps": "io/recorded studies/finished",
    "thermal/test_composed": (
        "thermal/attenuation thermal/conduction thermal/part thermal/reflection thermal/view_dependence"
    ),
    "thermal/test_energy_network": "thermal/ellipsoid_balance thermal/land_cover thermal/residual_network thermal/weather_drive",
    "thermal/test_imaging_field": "thermal/coordinates",
    "thermal/test_radiative": "physics/grey_body",
    "thermal/test_static": "thermal/base thermal/clipping thermal/view_harmonics",
    "thermal/test_time_mlp": "thermal/layers",
    "training/test_auto_verdicts": "runs/prices runs/verdicts",
    "training/test_composite_runs": "sensors/band_composite sensors/composite sensors/total_composite",
    "training/test_runs": "training/checkpoints training/module training/rng training/session",
    "benchmarks/test_renderer": "kernels/peak",
}
LONGEST = 117  # modules; lower it when some go


def modules() -> list[str]:
    """Modules in packages as "package/module" or "package/folder/module"."""
    return sorted(
        f"{name}/{path.relative_to(folder).with_suffix('')}"
        for name, folder in PACKAGES.items()
        for path in folder.rglob("*.py")
        if path.name != "__init__.py"
    )


def has_own(module: str) -> bool:
    *_, folder, stem = module.split("/")
    tests = ROOT / "tests" / module.split("/")[0]
    return any((tests / f"{name}.py").exists() for name in (f"test_{stem}", f"test_{folder}_{stem}"))


def test_a_module_has_a_test_file():
    listed, wrong = Counter(name for names in ELSEWHERE.values() for name in names.split()), []
    for module in modules():
        if has_own(module) and listed[module]:
            wrong.append(f"{module} has a test file of its own: take it off the list")
        elif not has_own(module) and listed[module] != 1:
            wrong.append(f"write tests/{module.split('/')[0]}/test_{module.split('/')[-1]}.py")
    assert len(modules()) > 400
    assert not wrong, "\n".join(wrong)


def test_the_list_names_files_and_modules_that_there_are_and_only_shrinks():
    listed = [name for names in ELSEWHERE.values() for name in names.split()]
    assert set(listed) <= set(modules())
    assert [file for file in ELSEWHERE if not (ROOT / "tests" / f"{file}.py").exists()] == []
    assert len(listed) == LONGEST
