"""The papers' hyperparameters, held against the configuration as composed with ``recipe=published``: that of the
papers, where the defaults have ways of ours (``density=budget``, rates that follow the length of a run, small networks).

A number here was read in the paper or in its authors' code, as the third column says, and never from conf/. Steps that conf/
gives as shares of a run may differ by what rounding the share does. Where a method departs from its paper, both numbers
stand in ``DEPARTURES``: whoever changes one has to say so here.
"""

import math
from functools import reduce
from operator import or_

import pytest
from helpers import ALL_METHODS, ROOT

from heatsplat.composition import build, compose

TERM = "loss.terms.photometric"
SUPIRGS_HF = "loss.terms.high_frequency"

UNLIMITED = {"max_steps": (30000, "iterations"), "density.cap_max": (math.inf, "no limit is printed")}
GAUSSIANS = {  # 3D Gaussian Splatting, arguments/__init__.py of the authors' code unless another source is named
    "optim.means": (1.6e-4, "position_lr_init"),
    "optim.means_end": (0.01, "position_lr_final / position_lr_init"),
    "optim.log_scales": (5e-3, "scaling_lr"),
    "optim.quats": (1e-3, "rotation_lr"),
    "optim.opacity_logits": (5e-2, "opacity_lr"),
    "optim.length_power": (0.0, "the same rates, whatever --iterations"),
    "optim.betas": ([0.9, 0.999], "torch.optim.Adam"),
    "optim.accumulate": (1, "train.py: optimizer.step in every iteration"),
    "optim.averaged": (0, "train.py: what the last iteration left is saved"),
    "optim.eps": (1e-15, "training_setup"),
    "renderer.background": (0.0, "train.py: bg_color is black unless --white_background"),
    "init.opacity": (0.1, "create_from_pcd"),
    "init.scale": (1.0, "create_from_pcd: the distance to three neighbours"),
    "init.thinnest": (1.0, "create_from_pcd: repeat(1, 3)"),
}
GROWTH = {
    "start": (500, "densify_from_iter"),
    "stop": (15000, "densify_until_iter"),
    "every": (100, "densification_interval"),
    "grad_threshold": (2e-4, "densify_grad_threshold"),
    "duplicate_scale": (0.01, "percent_dense"),
    "prune_opacity": (0.005, "min_opacity of densify_and_prune"),
    "prune_scale": (0.1, "big_points_ws of densify_and_prune"),
    "reset_every": (3000, "opacity_reset_interval"),
    "reset_opacity": (0.01, "reset_opacity"),
    "absgrad": (False, "as published; AbsGS came later"),
}
ADAPTIVE = {f"density.{key}": value for key, value in GROWTH.items()}
COLOUR = {  # static emission
    "thermal.lr": (2.5e-3, "feature_lr"),
    "thermal.sh_degree": (3, "sh_degree"),
    "thermal.sh_degree_interval": (1000, "train.py: oneupSHdegree"),
    "renderer.eps2d": (0.3, "compute_cov2D: low-pass filter"),
    "renderer.antialiased": (False, "as published"),
    "renderer.far": (1e10, "no far plane"),
}
PHOTOMETRIC = {
    f"{TERM}.dssim_weight": (0.2, "lambda_dssim"),
    f"{TERM}.dssim_half": (False, "1 - ssim in train.py"),
}
BOTH_IMAGES = {  # ThermalGaussian and 3DGS+IR: a colour and a thermal image, each with 3DGS's loss
    "thermal.sh_degree": (3, "sh_degree"),
    "thermal.companions.rgb": (3, "RGB"),
}
BOTH_PHOTOMETRIC = {
    "loss.terms.thermal.term.dssim_weight": (0.2, "3DGS"),
    "loss.terms.rgb.term.dssim_weight": (0.2, "3DGS"),
}
FROZEN = {key: value for key, value in ADAPTIVE.items() if not key.endswith("stop")}

DEFORMING_FIELD = {  # the network of Thermal3D-GS's code, which TI-3DGS's is read as
    "thermal.width": (256, "W"),
    "thermal.depth": (8, "D"),
    "thermal.skip": (5, "after index 4"),
    "thermal.positions": ("world", "xyz as it is"),
    "thermal.time": ("index", "fid / (N - 1)"),
    "thermal.exponent_max": (None, "no bound"),
    "thermal.emission.sh_degree": (3, "sh_degree"),
}
SHARED = {  # what a method has of others
    "3dgs": (GAUSSIANS, ADAPTIVE, COLOUR, PHOTOMETRIC),
    "3dgs_ir": (GAUSSIANS, ADAPTIVE, BOTH_IMAGES),
    "bicubic_3dgs": (GAUSSIANS, ADAPTIVE, COLOUR, PHOTOMETRIC),
    "lanczos_3dgs": (GAUSSIANS, ADAPTIVE, COLOUR, PHOTOMETRIC),
    "direct_3dgs": (GAUSSIANS, ADAPTIVE, COLOUR),
    "energy_balance": (GAUSSIANS, ADAPTIVE, PHOTOMETRIC),
    "etgs": (GAUSSIANS, ADAPTIVE),
    "etgs_released": (GAUSSIANS, ADAPTIVE, PHOTOMETRIC),
    "hexplane_4dgs": (GAUSSIANS, ADAPTIVE),
    "mftg": (GAUSSIANS, BOTH_IMAGES, BOTH_PHOTOMETRIC),
    "mip_splatting": (GAUSSIANS, ADAPTIVE, PHOTOMETRIC),
    "msmg": (GAUSSIANS, ADAPTIVE, BOTH_IMAGES, BOTH_PHOTOMETRIC),
    "ntr_gaussian": (GAUSSIANS, FROZEN, PHOTOMETRIC),
    "ommg": (GAUSSIANS, ADAPTIVE, BOTH_IMAGES, BOTH_PHOTOMETRIC),
    "ravigs": (GAUSSIANS, ADAPTIVE, BOTH_PHOTOMETRIC),
    "scaffold_gs": (PHOTOMETRIC,),
    "srgs": (GAUSSIANS, ADAPTIVE, COLOUR),
    "supirgs": (GAUSSIANS, ADAPTIVE, COLOUR),
    "thermal3dgs": (GAUSSIANS, ADAPTIVE, DEFORMING_FIELD),
    "thermalgs": (GAUSSIANS, FROZEN, PHOTOMETRIC),
    "thermogs": (GAUSSIANS, FROZEN),
    "ti3dgs": (GAUSSIANS, ADAPTIVE, DEFORMING_FIELD),
}
OWN = {
    "3dgs_ir": {
        "loss.terms.thermal.dssim_weight": (0.2, "3DGS"),
        "loss.terms.rgb.dssim_weight": (0.2, "3DGS"),
        "thermal.shared_opacity": (True, "one opacity"),
        "thermal.sh_degree_interval": (1000, "3DGS: oneupSHdegree"),
    },
    "bicubic_3dgs": {"data.degrade": ("lr4", "SupIR-GS, Tab. 1: x4")},
    "lanczos_3dgs": {"data.degrade": ("lr4", "SupIR-GS, Tab. 1: x4")},
    "direct_3dgs": {"module.supersample": (4, "SupIR-GS, Tab. 1: x4")},
    "etgs": {
        "thermal.frequencies": (24, "App. B: K"),
        "thermal.frequency_gain": (2**-0.5, "App. B: alpha"),
        "thermal.ambient": ("measured", "constant T_env of the scene"),
        "thermal.param": ("faithful", "Eq. 3-6: C, h, A, B"),
        "thermal.separation": (0.0, "App. B: equal ones go"),
        "thermal.penalty": ("ridge", "Eq. 11"),
        "thermal.penalty_reduction": ("sum", "Eq. 11"),
        "thermal.penalty_units": ("si", "Eq. 3: seconds and degrees"),
        "thermal.source_penalty": (1e-5, "train.py: lambda"),
        "thermal.gauge_l2": (0.0, "Eq. 11"),
        "thermal.clip": ("hard", "Eq. 9"),
        "thermal.lr_initial": (2.5e-3, "3DGS: feature_lr"),
        f"{TERM}.dssim_weight": (0.2, "Eq. 36, lambda of 3DGS"),
        f"{TERM}.dssim_half": (True, "Eq. 36: (1 - SSIM) / 2"),
    },
    "etgs_released": {
        "thermal.frequencies": (24, "gaussian_model.py: K_default"),
        "thermal.frequency_gain": (0.25, "gaussian_model.py: alpha"),
        "thermal.tau_min_s": (60.0, "gaussian_model.py: tau_min"),
        "thermal.separation": (0.5, "gaussian_model.py: f_sep"),
        "thermal.source_penalty": (1e-5, "train.py: lambda_group_ab"),
        "thermal.penalty_reduction": ("sum", "train.py: group_energy"),
        "thermal.ambient": ("measured", "gaussian_model.py: T_env of info.json"),
        "thermal.clip": ("hard", "gaussian_model.py: clamp"),
        "thermal.time_constant_s": (60.0, "gaussian_model.py: tau_init"),
        "thermal.source_scale": (1e-3, "gaussian_model.py: gamma_init"),
        "thermal.lr_initial_c": (0.1, "arguments: T0"),
        "thermal.lr_time_constant_s": (0.1, "arguments: tau_lr"),
        "thermal.lr_source_scale": (1e-3, "arguments: gamma_lr"),
        "thermal.lr_gains": (2e-3, "arguments: ab_lr"),
        "thermal.lr_end": (1.0, "gaussian_model.py: update_learning_rate"),
        "optim.opacity_logits": (2.5e-2, "arguments: opacity_lr"),
    },
    "hexplane_4dgs": {
        "first_steps": (3000, "coarse_iterations"),
        "density.cap_max": (360000, "train.py: no growth beyond"),
        "thermal.heads": (["means", "scales", "rotations"], "no_do, no_dshs"),
        "thermal.resolution": (64, "resolution of dnerf_default"),
        "thermal.time_resolution": (25, "resolution of dnerf_default"),
        "thermal.channels": (32, "output_coordinate_dim"),
        "thermal.lr": (1.6e-4, "deformation_lr_init"),
        "thermal.lr_planes": (1.6e-3, "grid_lr_init"),
        f"{TERM}.dssim_weight": (0.0, "lambda_dssim"),
        "thermal.emission.sh_degree": (3, "sh_degree"),
        "thermal.scales": ([1, 2], "multires of dnerf_default"),
        "thermal.width": (64, "net_width"),
        "thermal.leak": (0.0, "nn.ReLU in scene/deformation.py"),
        "thermal.smooth_space": (1e-4, "plane_tv_weight"),
        "thermal.smooth_time": (1e-2, "time_smoothness_weight"),
        "thermal.sparse_time": (1e-4, "l1_time_planes"),
        "thermal.lr_end": (0.1, "deformation_lr_final / deformation_lr_init"),
        "thermal.emission.lr": (2.5e-3, "feature_lr"),
    },
    "mftg": {
        "max_steps": (60000, "30000 on colour, 30000 on thermal images"),
        "density.grad_threshold": GROWTH["grad_threshold"],
        "density.stop": (15000, "of each round's 30000"),
        "first_steps": (30000, "of 60000"),
        "loss.terms.smoothness.term.weight": (0.6, "train.py: lambda of smoothness"),
    },
    "mip_splatting": {
        "smoothing.variance": (0.2, "compute_3D_filter: sqrt(0.2) of the sampling interval"),
        "smoothing.every": (100, "train.py"),
        "smoothing.near": (0.2, "compute_3D_filter"),
        "smoothing.margin": (0.15, "compute_3D_filter"),
        "renderer.eps2d": (0.1, "kernel_size"),
        "renderer.antialiased": (True, "2D Mip filter"),
    },
    "msmg": {
        "thermal.shared_opacity": (False, "two models"),
        "init.separate": (True, "two clouds"),
        "loss.terms.thermal.weight": (0.6, "MSMG: .6"),
        "loss.terms.rgb.weight": (0.3, "MSMG: .3"),
        "loss.terms.smoothness.weight": (0.36, ".6 of .6"),
    },
    "ntr_gaussian": {
        "max_steps": (20000, "10000 of each stage"),
        "first_steps": (10000, "10000 of geometry"),
        "thermal.width": (64, "T-net: 64"),
        "thermal.frames_per_cycle": (None, "all octaves of time"),
        "thermal.time": ("record", "time of the record"),
        "thermal.feature_size": (32, "of Feature-3DGS"),
        "thermal.variation": (1.0, "without a weight"),
        "thermal.nodes": (6, "nodes of the trapezoid rule"),
        "thermal.window_s": (3600.0, "one hour"),
        "thermal.position_frequencies": (10, "L"),
        "thermal.time_frequencies": (10, "L"),
        "thermal.environment": (1.0, "mean (env - default)^2"),
        "thermal.integral": (0.002, "train.py"),
        "thermal.lr": (1.6e-3, "T-net"),
    },
    "ommg": {
        "thermal.shared_opacity": (True, "one opacity"),
        "loss.terms.thermal.weight": (0.5, "L = 1/2 (L_RGB + L_T)"),
        "loss.terms.rgb.weight": (0.5, "L = 1/2 (L_RGB + L_T)"),
        "loss.terms.smoothness.weight": (0.3, "1/2 of .6"),
    },
    "ravigs": {
        "density.prune_opacity": (0.005, "Eq. 11: tau"),
        "thermal.dual_opacity": (True, "section 3.3"),
        "thermal.three_parameter": (True, "section 3.2"),
        "thermal.lr_attributes": (2.5e-3, "section 4.1"),
        "thermal.lr_rest": (2.5e-3 / 20, "3DGS: feature_lr / 20"),
        "thermal.degrees": ({"emissivity": 3, "temperature": 3, "reflectance": 3}, "section 3.2: as the colours"),
        "thermal.clip": ("hard", "Eq. 5"),
        "stages.freezes.rgb.start": (3000, "section 4.1"),
        "stages.freezes.rgb.share": (0.2, "section 4.1: 20 %"),
        "loss.terms.physical_prior.term.reduction": ("mean", "Eq. 15"),
        "loss.terms.physical_prior.term.of": ("coefficients", "Eq. 15"),
        "thermal.color.sh_degree": (3, "3DGS"),
        "loss.terms.gradient.weight": (0.5 * 0.05, "lambda_rgb lambda_g"),
        "loss.terms.guided_variation.weight": (0.5 * 0.02, "lambda_ir lambda_s"),
        "loss.terms.physical_prior.weight": (0.5 * 0.01, "lambda_ir lambda_p"),
        "loss.terms.physical_prior.term.tolerance": (0.05, "Eq. 15: delta"),
    },
    "srgs": {
        "super_resolution": (4, "x4"),
        f"{TERM}.factor": (4, "x4"),
        f"{TERM}.target_weight": (0.6, "train.py, the commented line"),
        f"{TERM}.sr_only": (False, "the paper: both terms"),
        f"{TERM}.kernel": ("area", "average pooling"),
        f"{TERM}.dssim_weight": (0.2, "3DGS"),
    },
    "supirgs": {
        "super_resolution": (4, "x4"),
        "module.supersample": (4, "x4"),
        "sensor.parts.calibration.grid": (16, "section 3.2"),
        "sensor.parts.calibration.weight": (5e-4, "lambda_cal"),
        "sensor.parts.tone.straight": (True, "Eq. 8"),
        "sensor.parts.tone.exact": (True, "Eq. 7: of each pixel"),
        f"{SUPIRGS_HF}.term.inner": (3, "after Eq. 9: a difference of averages"),
        "sensor.parts.tone.width": (64, "Eq. 7: two hidden layers of 64"),
        "sensor.parts.tone.gain_max": (0.08, "Eq. 8"),
        "sensor.parts.tone.offset_max": (0.04, "Eq. 8"),
        "sensor.parts.tone.weight": (1e-3, "lambda_tone"),
        f"{TERM}.term.ssim_schedule.start": (0.10, "SSIM 10-40 %"),
        f"{TERM}.term.ssim_schedule.end": (0.40, "SSIM 10-40 %"),
        f"{TERM}.term.boost_schedule.start": (0.55, "late-stage boosting 55-95 %"),
        f"{TERM}.term.boost_schedule.end": (0.95, "late-stage boosting 55-95 %"),
        f"{SUPIRGS_HF}.schedule.start": (0.65, "HF 65-95 %"),
        f"{SUPIRGS_HF}.schedule.end": (0.95, "HF 65-95 %"),
    },
    "thermal3dgs": {
        "loss.terms.corner.term.weight": ("published", "train.py"),
        "sensor.parts.conduction.width": (1, "1x1 convolutions of one channel"),
        "sensor.parts.conduction.norm": ("columns", "F.normalize without a batch"),
        "thermal.position_frequencies": (10, "multires"),
        "thermal.time_frequencies": (10, "t_multires"),
        "thermal.frames_per_cycle": (None, "all of them"),
        "thermal.lr": (8e-4, "1.6e-4 times the spatial scale 5"),
        "thermal.lr_end": (1.6e-6 / 8e-4, "position_lr_final"),
        "thermal.exponent": ("printed", "unconstrained"),
        "sensor.parts.conduction.hidden": (2, "three 1x1 convolutions"),
        "sensor.parts.conduction.lr": (1.6e-5, "TCM"),
        "sensor.parts.conduction.lr_end": (0.1, "TCM: 1.6e-6"),
        f"{TERM}.weight": (0.8, ".6 L1 + .2 (1 - SSIM)"),
        f"{TERM}.term.dssim_weight": (0.25, ".2 of .8"),
        "loss.terms.corner.weight": (0.2, "train.py"),
        "loss.terms.corner.schedule.end": (5000 / 30000, "max(1 - i / 5000, 0)"),
        "loss.terms.corner.schedule.before": (1.0, "max(1 - i / 5000, 0)"),
        "loss.terms.corner.schedule.after": (0.0, "max(1 - i / 5000, 0)"),
    },
    "thermalgs": {
        "thermal.time_frequencies": (4, "GaussianMeshTimeModel in NTR-Gaussian's code"),
        "thermal.code_size": (16, "GaussianMeshTimeModel"),
        "thermal.lr": (2.5e-3, "GaussianMeshTimeModel: MLP"),
        "thermal.lr_time": (1e-3, "GaussianMeshTimeModel: time encoder"),
    },
    "thermogs": {
        "loss.terms.data.weight": (0.8, "lambda_1"),
        "loss.terms.edge.weight": (0.2, "lambda_2"),
        "thermal.weights.smooth": (1.0, "lambda_3"),
        "thermal.weights.physical": (0.01, "lambda_4"),
        "thermal.weights.ode": (0.01, "lambda_5"),
        "thermal.weights.pinn": (1.0, "lambda_6"),
        "thermal.time_frequencies": (10, "orders of the time encoding"),
        "thermal.frames_per_cycle": (None, "all of them"),
        "thermal.time": ("record", "min-max time"),
        "thermal.width": (256, "our reading"),
        "thermal.blocks": (6, "our reading"),
        "thermal.projected_area": ("printed", "Eq. 8"),
        "thermal.surface_area": ("printed", "Eq. 6"),
        "thermal.sky": ("none", "Eq. 3: empty space"),
    },
    "scaffold_gs": {  # arguments/__init__.py of the authors' code unless another source is named
        "optim.means": (0.0, "position_lr_init"),
        "optim.log_scales": (7e-3, "scaling_lr"),
        "optim.length_power": (0.0, "the same rates, whatever --iterations"),
        "thermal.gaussians": (10, "n_offsets"),
        "thermal.feature_size": (32, "feat_dim"),
        "thermal.distance": (True, "section 3.2"),
        "thermal.volume": (0.01, "train.py: scaling_reg"),
        "thermal.lr_feature": (7.5e-3, "feature_lr"),
        "thermal.lr_offsets": (1e-2, "offset_lr_init"),
        "thermal.lr_reach": (7e-3, "scaling_lr"),
        "thermal.lr_opacity": (2e-3, "mlp_opacity_lr_init"),
        "thermal.lr_shape": (4e-3, "mlp_cov_lr_init"),
        "thermal.lr_value": (8e-3, "mlp_color_lr_init"),
        "thermal.ends": ([0.01, 0.01, 1.0, 5e-5 / 8e-3], "offset_lr_final and so on, over the rates"),
        "density.start": (500, "start_stat"),
        "density.grow_from": (1500, "update_from"),
        "density.stop": (15000, "update_until"),
        "density.every": (100, "update_interval"),
        "density.seen": (0.8, "success_threshold"),
        "density.grad_threshold": (2e-4, "densify_grad_threshold"),
        "density.prune_opacity": (0.005, "min_opacity"),
        "density.coarsest": (16, "update_init_factor"),
        "density.finer": (4, "update_hierachy_factor"),
        "density.levels": (3, "update_depth"),
        "density.voxel": (None, "voxel_size of 0: the median distance"),
    },
    "ti3dgs": {
        "thermal.frames_per_cycle": (None, "Eq. 11"),
        "thermal.applies_to": ("harmonics", "Eq. 12"),
        "thermal.emission.floor": (False, "Eq. 12: coefficients, of which the rasteriser makes colours"),
        "thermal.gauge": (0.0, "none"),
        "density.radiance.sh0": (0.0, "Eq. 14"),
        "thermal.position_frequencies": (10, "Eq. 11: L"),
        "thermal.time_frequencies": (10, "Eq. 11: L"),
        "thermal.exponent": ("printed", "Eq. 9-10: no constraint"),
        "thermal.lr": (8e-4, "section IV-B"),
        "thermal.lr_end": (1.6e-6 / 8e-4, "section IV-B"),
        f"{TERM}.dssim_weight": (0.2, "3DGS"),
    },
}
PAPERS = {method: reduce(or_, (UNLIMITED, *shared, OWN.get(method, {}))) for method, shared in SHARED.items()}

DEPARTURES = {  # ours, also with the recipe, and the published number
    "srgs": {"teacher": ("lanczos", "SwinIR")},
    "supirgs": {"teacher": ("lanczos", "SwinIR-S"), f"{TERM}.term.boost_weight": (0.0, "undefined")},
    "thermogs": {"thermal.features": ("learned", "given: of Feature-3DGS")},
}
STEPS = ("start", "grow_from", "stop", "every", "first_steps", "sh_degree_interval", "reset_every")
SHARE_ROUNDED = 0.005  # 0.0167 of a run for 500 of 30000 steps, 0.1667 for 5000


@pytest.fixture(scope="module")
def composed():
    """method -> its configuration, each composed when it is asked for first."""
    known = {}

    def of(method):
        if method not in known:
            known[method] = compose([f"method={method}", "recipe=published"])
        return known[method]

    return of


def at(config, key):
    for name in key.split("."):
        config = config[name]
    return config


@pytest.mark.parametrize(
    ("steps", "rate", "rest"),
    [(20, 1e-2, 1.5e-3), (1500, 1e-2, 1.5e-3), (5000, 3e-3, 4.5e-4), (30000, 2.5e-3, 1.25e-4)],
)
def test_short_runs_of_ravigs_reach_as_far_with_its_attributes(steps, rate, rest):
    thermal = compose(["method=ravigs", f"max_steps={steps}"])["thermal"]
    assert (thermal["lr_attributes"], thermal["lr_rest"]) == pytest.approx((rate, rest))


def test_every_method_here_exists():
    assert set(PAPERS) <= set(ALL_METHODS) and set(DEPARTURES) <= set(PAPERS)


def test_every_option_that_the_recipe_knows_exists():
    """Its files are optional to Hydra: one whose name fits no option would never be read."""
    files = list((ROOT / "conf" / "recipe").glob("*/*.yaml"))
    groups = {path: "method" if path.parent.name == "methods" else path.parent.name for path in files}
    unread = [path for path, group in groups.items() if not _option(group, path.stem).is_file()]
    assert files and not unread


def _option(group, name):
    return ROOT / "conf" / group / f"{name.removeprefix('published_')}.yaml"


@pytest.mark.parametrize(
    ("method", "overrides"),
    [
        ("etgs", ["thermal=static"]),
        ("thermal3dgs", ["thermal=static"]),
        ("ti3dgs", ["density=adaptive"]),
        ("thermal3dgs", ["loss=photometric", "sensor=none"]),
        ("supirgs", ["loss=photometric", "sensor=none"]),
    ],
)
def test_parts_of_a_method_that_are_exchanged_have_their_own_published_settings(method, overrides):
    """As rows of ablations do: no part gets what the recipe says of another."""
    config = compose([f"method={method}", "recipe=published", *overrides])
    if overrides == ["thermal=static"]:
        assert build(config["thermal"]).sh_degree == 3
    for name in ("thermal", "density", "sensor"):
        build(config[name])


def test_presets_and_the_command_line_shorten_the_recipe():
    config = compose(["method=mftg", "recipe=published", "preset=fast"])
    assert (config["max_steps"], config["density"]["cap_max"], config["optim"]["length_power"]) == (2000, 30000, 0)
    assert compose(["method=etgs", "recipe=published", "max_steps=7"])["max_steps"] == 7


def test_without_the_recipe_nothing_of_it_is_there():
    ours = compose(["method=ti3dgs"])
    assert "published" not in ours and ours["thermal"]["width"] == 32 and ours["optim"]["length_power"] == 0.5


@pytest.mark.parametrize("table", ["etgs_1", "supirgs_1"])
def test_tables_have_the_recipe_and_the_papers_lpips(table):
    """All of them begin with the same file; the second has recipes of its methods, too."""
    config = compose([f"experiment=table_{table}", "data.root=/nowhere", "data.scene=s", "hydra.mode=RUN"])
    assert config["published"]["steps"] == config["max_steps"] == 30000
    assert config["optim"]["length_power"] == 0 and config["callbacks"]["metrics"]["lpips_net"] == "vgg"


@pytest.mark.parametrize("method", PAPERS)
def test_settings_are_those_of_the_paper(method, composed):
    wrong = []
    for key, (published, source) in PAPERS[method].items():
        ours = at(composed(method), key)
        if isinstance(published, float) or key.rpartition(".")[2] in STEPS:
            same = ours == pytest.approx(published, rel=SHARE_ROUNDED)
        else:
            same = ours == published
        if not same:
            wrong.append(f"{key} is {ours}, published: {published} ({source})")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("method", DEPARTURES)
def test_departures_from_the_paper_are_the_stated_ones(method, composed):
    for key, (ours, published) in DEPARTURES[method].items():
        assert at(composed(method), key) == ours != published, key
