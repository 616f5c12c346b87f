"""Images that grow over a run: sizes, spectra, averaged targets, masks, all methods, resuming."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import ALL_METHODS
from running import TINY, run
from scipy.fft import dctn
from test_runs import state_of

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, View
from heatsplat.geometry.spectrum import RINGS, held
from heatsplat.runs.stepping import Stepper
from heatsplat.sensors.base import Composite
from heatsplat.training import resolution
from heatsplat.training.resolution import (
    RATIOS,
    CoarseToFine,
    Cosine,
    Pyramid,
    area_average,
    rendered,
)

GROWING = {
    "coarse_to_fine": CoarseToFine,
    "cosine": Cosine,
    "pyramid": lambda: Pyramid([8, 4, 2, 1], [0, 0.1, 0.25, 0.5]),
}
PROGRESS = np.linspace(0, 1, 201)


def camera(width=160, height=128):
    focal = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    return Camera(torch.eye(4), focal, width, height)


def scene_of(*images, mask=None):
    """The little of a scene that a schedule looks at."""
    views = [
        View(Frame(f"{i}", i, camera(image.shape[1], image.shape[0])), thermal=image.float(), mask=mask)
        for i, image in enumerate(images)
    ]

    class Views(list):
        frames = [view.frame for view in views]

    return SimpleNamespace(train=Views(views))


def prepared(schedule, *images, supersample=1, mask=None):
    schedule.prepare(scene_of(*images, mask=mask), ("thermal",), Composite(), supersample)
    return schedule


def white(size=512, seed=0):
    return 0.5 + 0.1 * torch.randn(size, size, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def inverse_frequency(size=512, seed=0):
    """An image whose amplitudes fall with the inverse of the frequency, as natural ones do."""
    waves = torch.fft.rfft2(white(size, seed)[..., 0])
    distance = torch.hypot(torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size))
    distance[0, 0] = math.inf
    image = torch.fft.irfft2(waves / distance)
    return (0.5 + 0.1 * image / image.std())[..., None]


def ramp(size=512):
    along = torch.linspace(0, 1, size, dtype=torch.float64)
    return (0.3 * along[:, None] + 0.7 * along)[..., None]


# Sizes over the run ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GROWING)
@pytest.mark.parametrize("size", [(512, 410), (160, 128), (65, 70)])
def test_ratios_fall_from_the_first_to_full_size_and_leave_enough_pixels(name, size):
    images = [inverse_frequency(512, seed)[: size[1], : size[0]] for seed in range(2)]
    schedule = prepared(GROWING[name](), *images)
    found = [schedule.ratio(progress) for progress in PROGRESS]
    assert set(found) <= set(RATIOS)
    assert all(after <= before for before, after in zip(found, found[1:], strict=False))
    assert all(ratio == 1 for progress, ratio in zip(PROGRESS, found, strict=True) if progress >= schedule.until)
    sides = [rendered(camera(*size), 1 / ratio) for ratio in found]
    assert min(min(side.width, side.height) for side in sides) >= 64
    assert found[0] == {(512, 410): {"coarse_to_fine": 4, "cosine": 3, "pyramid": 6}[name], (160, 128): 2}.get(size, 1)


def test_a_run_without_a_schedule_has_full_size_and_gives_back_what_it_got():
    off = build({"_target_": "heatsplat.training.resolution.Resolution"})
    view = scene_of(ramp(64)).train[0]
    assert {off.ratio(progress) for progress in PROGRESS} == {1.0}
    assert off.reduced(view, 1.0) is view
    assert rendered(view.camera, 1) is view.camera
    assert type(compose(["method=3dgs"])["module"]["resolution"]) is dict
    assert compose(["method=3dgs"])["module"]["resolution"]["_target_"].endswith(".Resolution")


def first_ratio(*images, **options):
    """What coarse_to_fine begins with, before it is taken down to one of the ratios."""
    return prepared(CoarseToFine(**options), *images).wanted(0.0)


def test_the_first_size_follows_from_the_spectrum():
    assert first_ratio(white()) == pytest.approx(2, rel=0.05)
    assert first_ratio(inverse_frequency()) == pytest.approx(4, rel=0.1)
    assert first_ratio(ramp()) == first_ratio(torch.full((512, 512, 1), 0.4)) == 8  # the most


def test_a_constant_image_stays_coarsest_until_the_end_of_growth():
    schedule = prepared(CoarseToFine(), torch.full((512, 512, 1), 0.4))
    assert {schedule.ratio(progress) for progress in PROGRESS if progress < 0.5} == {8.0}


def test_noise_of_the_camera_is_no_detail():
    clean = torch.nn.functional.avg_pool2d(inverse_frequency(512).permute(2, 0, 1)[None], 9, 1, 4)[0, 0, ..., None]
    noisy = [clean + 0.7 * (white(512, seed) - 0.5) for seed in range(1, 9)]
    with_floor = first_ratio(*noisy)
    without = 1 / np.interp(0.25, held(np.sqrt(power_by_ring(noisy))), np.linspace(0, 1, RINGS + 1))
    assert first_ratio(clean) == 8  # the most
    assert with_floor > 6 > 3 > without


def power_by_ring(images):
    """Sums of amplitudes squared, times counts, by a plain loop over rings."""
    total = np.zeros(RINGS)
    for image in images:
        waves = dctn(image.numpy()[..., 0], norm="ortho")
        waves[0, 0] = 0
        rows, columns = (np.arange(side) / side for side in waves.shape)
        place = np.floor(RINGS * np.maximum(rows[:, None], columns))
        for ring in range(RINGS):
            inside = waves[place == ring]
            total[ring] += np.mean(inside**2) * inside.size**2
    return total


def test_the_finest_of_several_modalities_decides():
    scene = scene_of(ramp(512))
    scene.train[0] = replace(scene.train[0], rgb=white(512).float().expand(-1, -1, 3))
    schedule = CoarseToFine()
    schedule.prepare(scene, ("thermal", "rgb"), Composite(), 1)
    assert schedule.ratio(0.0) == 1.5 or schedule.ratio(0.0) == 2


def test_fine_renders_are_whole_multiples_of_the_training_images_or_not_finer():
    schedule = prepared(CoarseToFine(short_side=16), inverse_frequency(128), supersample=4)
    found = {schedule.ratio(progress) for progress in PROGRESS}
    assert found <= {1.0, 4.0, 6.0, 8.0} and schedule.ratio(0.0) == 8
    view = schedule._scene.train[0]
    assert schedule.reduced(view, 4.0) is view
    assert schedule.reduced(view, 8.0).thermal.shape == (64, 64, 1)
    assert rendered(view.camera, 4 / 8.0).width == 64


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: CoarseToFine(until=0), "until"),
        (lambda: CoarseToFine(share=1), "share"),
        (lambda: Cosine(start=0), "start"),
        (lambda: Pyramid([8, 1], [0.1, 0.5]), "ratios"),
        (lambda: Pyramid([2, 4, 1], [0, 0.1, 0.5]), "ratios"),
        (lambda: Pyramid([4, 2], [0, 0.5]), "ratios"),
        (lambda: Pyramid([4, 1], [0, 0.2, 0.5]), "ratios"),
    ],
)
def test_what_is_out_of_range_is_named(make, said):
    with pytest.raises(ValueError, match=f"schedule.{said}"):
        make()


# Targets --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(6, 10), (7, 11), (5, 3)])
def test_targets_are_averages_over_the_area_of_their_pixels(size):
    image = torch.rand(12, 20, 2, dtype=torch.float64)
    repeated = image.repeat_interleave(size[0], 0).repeat_interleave(size[1], 1)  # one grid that both divide
    expected = repeated.reshape(size[0], 12, size[1], 20, 2).mean((1, 3))
    found, mask = area_average(image, None, *size)
    assert mask is None and torch.allclose(found, expected, atol=1e-12)


def test_masked_pixels_stay_out_of_targets():
    image, mask = torch.full((4, 6, 1), 0.3), torch.ones(4, 6, dtype=torch.bool)
    mask[:2, :2] = False  # a whole coarse pixel
    mask[:2, 2] = False  # half of one
    mask[2, 4:], mask[3, 4] = False, False  # three quarters of one
    image[~mask] = torch.nan
    found, counts = area_average(image, mask, 2, 3)
    assert counts.tolist() == [[False, True, True], [True, True, False]]
    assert torch.allclose(found[counts], torch.tensor(0.3)) and found[~counts].isnan().all()


def test_noise_averages_down():
    found, _ = area_average(white(512), None, 128, 128)
    assert found.std().item() == pytest.approx(0.1 / 4, rel=0.03)


def test_cameras_of_targets_see_the_same_directions():
    schedule = prepared(CoarseToFine(), ramp(410).expand(410, 410, 1)[:, :333])
    view = schedule._scene.train[0]
    small = schedule.reduced(view, 3.0)
    assert (small.camera.width, small.camera.height) == (111, 137)
    point = torch.tensor([[0.3, -0.2, 2.0]])
    place, small_place = view.camera.project(point)[0], small.camera.project(point)[0]
    assert torch.allclose(small_place / torch.tensor([111.0, 137.0]), place / torch.tensor([333.0, 410.0]))


def test_coarse_targets_know_where_images_were_cut_off():
    schedule = prepared(CoarseToFine(), white(128))
    view = schedule._scene.train[0]
    ends = torch.zeros(128, 128, dtype=torch.int8)
    ends[5, 9], ends[100, 4] = 1, -1
    small = schedule.reduced(replace(view, ends=ends), 2.0)
    assert small.ends.nonzero().tolist() == [[2, 4], [50, 2]] and small.ends.sum() == 0
    assert small.known.sum() == 64 * 64 - 2


def test_targets_are_kept_while_the_ratio_stays_and_no_more_than_fit(monkeypatch):
    schedule = prepared(CoarseToFine(), *(white(128, seed) for seed in range(3)))
    first, second, third = schedule._scene.train
    kept = schedule.reduced(first, 2.0)
    assert schedule.reduced(first, 2.0) is kept and kept.clean is None
    monkeypatch.setattr(resolution, "KEPT_BYTES", 2 * kept.thermal.nbytes)
    assert schedule.reduced(second, 2.0) is schedule.reduced(second, 2.0)
    again = schedule.reduced(third, 2.0)
    assert schedule.reduced(third, 2.0) is not again and torch.equal(
        schedule.reduced(third, 2.0).thermal, again.thermal
    )
    assert schedule.reduced(first, 1.5).camera.width == 85
    assert schedule.reduced(first, 2.0) is not kept


# Training -------------------------------------------------------------------------------------------------------------

SHORT = (
    *TINY,
    "max_steps=8",
    "density.start=1",
    "density.every=2",
    "density.stop=6",
    "trainer.val_check_interval=8",
    "trainer.limit_val_batches=1",
    "schedule=pyramid",
    "schedule.short_side=8",
)


@pytest.mark.parametrize("method", sorted(set(ALL_METHODS) - {"auto", "thermonerf"}))
def test_every_method_trains_at_every_size(method, tmp_path):
    plain = compose([*TINY, f"method={method}", "max_steps=8", "schedule=pyramid", "schedule.short_side=8"])
    stepper = Stepper(build(plain["module"]), build(plain["data"]).scene, step=0, device="cpu")
    module, sizes = stepper.module, []
    for step in range(8):
        module.trainer.global_step = step
        view = module.scene.train[step % len(module.scene.train)]
        stepper.step(view)
        sizes.append(module.resolution.ratio(module.schedule.progress(step)))
    assert sizes[0] > sizes[2] > sizes[4] == 1.0
    assert all(parameter.isfinite().all() for parameter in module.parameters())


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(tmp_path):
    overrides = (*SHORT, "method=etgs", "test=false", "max_steps=16", "schedule=coarse_to_fine")
    overrides = (*overrides, "callbacks.checkpoint.every_n_train_steps=3")
    whole = state_of(*run(tmp_path / "whole", *overrides))
    half = tmp_path / "whole" / "checkpoints" / "step_000003.ckpt"
    again = run(tmp_path / "resumed", *overrides, f"ckpt={half}")
    ratios = [again[0].resolution.ratio(step / 16) for step in range(16)]
    assert ratios[3] > 1 and ratios[8] == 1
    resumed = state_of(*again)
    assert [name for name in whole if not torch.equal(whole[name], resumed[name])] == []


def test_a_moved_end_moves_the_sizes_with_it():
    plain = compose([*TINY, "method=3dgs", "max_steps=100", "schedule=pyramid", "schedule.short_side=8"])
    module = build(plain["module"])
    module.attach(build(plain["data"]).scene)

    def ratio(step):
        return module.resolution.ratio(module.schedule.progress(step))

    assert ratio(24) > ratio(25) > ratio(50) == 1.0
    module.schedule.end_at(20, 60)  # 80 steps of the plan in 40
    assert ratio(22) > ratio(23) and ratio(34) > ratio(35) == 1.0


def test_screen_gradients_of_soft_scenes_are_the_same_at_half_size():
    plain = compose([*TINY, "method=3dgs", "data.size=demo", "data.frames=4", "max_steps=10", "init.count=300"])
    scene = build(plain["data"]).scene
    module = build(plain["module"])
    module.attach(scene)
    with torch.no_grad():
        module.splats["log_scales"].fill_(math.log(0.15 * scene.extent))  # many pixels wide
    view, found = scene.train[0], []
    for ratio in (1.0, 2.0):
        small = rendered(view.camera, 1 / ratio)
        output = module.render(replace(view.frame, camera=small), ratio=ratio)
        target, _ = area_average(view.thermal, None, small.height, small.width)
        (output.features - target).square().mean().backward()
        sides = torch.tensor([small.width, small.height]) / 2
        found.append((output.meta["means2d"].grad * sides).norm(dim=1))
    assert (found[1] - found[0]).norm() < 0.1 * found[0].norm()


def small_gaussians(method, pixels, *overrides):
    """A module on the tiny scene whose Gaussians are about so many pixels wide, and a frame."""
    module = build(compose([*TINY, f"method={method}", "init.count=400", *overrides])["module"])
    module.attach(build(compose([*TINY])["data"]).scene)
    frame = module.scene.train.frames[0]
    depth = frame.camera.project(module.splats.means.detach())[1].median()
    with torch.no_grad():
        module.splats["log_scales"].fill_(math.log(pixels * depth / frame.camera.K[0, 0]))
    return module, frame


@torch.no_grad()
def test_gaussians_are_as_thick_in_coarse_images_as_in_fine_ones():
    module, frame = small_gaussians("3dgs", 0.05, "renderer.antialiased=false", "renderer.eps2d=0.3")  # all blur
    small = replace(frame, camera=rendered(frame.camera, 0.5))
    full, scaled, thick = (
        seen.alpha.mean().item() for seen in (module.render(frame), module.render(small, ratio=2), module.render(small))
    )
    assert scaled == pytest.approx(full, rel=0.1)
    assert thick > 1.5 * full


@torch.no_grad()
def test_where_opacity_pays_for_blur_coarse_pixels_average_over_fine_ones():
    module, frame = small_gaussians("mip_splatting", pixels=0.7)
    small = replace(frame, camera=rendered(frame.camera, 0.25))
    wanted, _ = area_average(module.render(frame).alpha[0, ..., None], None, small.camera.height, small.camera.width)
    averaged = module.render(small, ratio=4).alpha[0, ..., None]
    module.renderer.eps2d /= 16
    sampled = module.render(small).alpha[0, ..., None]
    assert (averaged - wanted).norm() < 0.6 * (sampled - wanted).norm()
