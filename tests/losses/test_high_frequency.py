"""The high-frequency loss and its teachers: what is learnt, where it is trusted, and files that cannot serve."""

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, View, ViewSet
from heatsplat.geometry.resampling import resampled
from heatsplat.losses import swinir
from heatsplat.losses.compose import LossInputs, Weighted
from heatsplat.losses.high_frequency import HighFrequency, averaged
from heatsplat.losses.schedules import cosine
from heatsplat.losses.teacher import Interpolation, load_teacher

HEIGHT, WIDTH, FACTOR = 12, 16, 4


def noise(height=HEIGHT, width=WIDTH, channels=1, seed=0):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed))


def smooth(height=FACTOR * HEIGHT, width=FACTOR * WIDTH, seed=0):
    return resampled(noise(6, 8, seed=seed), height, width, "bicubic").clamp(0, 1)


def frame(index=0):
    return Frame(f"sub/{index:03d}.JPG", index, Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT))


def make_scene(count=2, mask=None):
    frames = [frame(i) for i in range(count)]
    views = ViewSet(frames, lambda i: View(frames[i], noise(seed=i), mask=mask))
    return SceneData("room", views, views, views, torch.zeros(4, 3))


def inputs(prediction, target=None, mask=None, step=99, index=0):
    target = noise() if target is None else target
    return LossInputs(prediction, target, mask, View(frame(index), target, mask=mask), None, step, step / 100)


class Oracle:
    """A teacher that knows the fine image."""

    description = "the truth"

    def __init__(self, fine):
        self.fine, self.asked = fine, 0

    def check(self, frame, factor):
        return

    def __call__(self, image, frame, factor):
        self.asked += 1
        return self.fine


# The loss -------------------------------------------------------------------------------------------------


def test_detail_is_what_averages_lose():
    term = HighFrequency(lambda: Interpolation("lanczos"), inner=1, outer=7)
    assert term.detail(torch.full((9, 9, 2), 0.7)).abs().max() < 1e-6  # at the border too
    spike = torch.zeros(21, 21, 1)
    spike[10, 10] = 1.0
    assert term.detail(spike)[10, 10].item() == pytest.approx(1 - 1 / 49)
    assert term.detail(spike)[10, 13].item() == pytest.approx(-1 / 49)
    band = HighFrequency(lambda: Interpolation("lanczos"), inner=3, outer=7)
    assert band.detail(spike)[10, 10].item() == pytest.approx(1 / 9 - 1 / 49)
    assert averaged(spike, 3)[0, 0] == 0 and averaged(torch.ones(5, 5, 1), 3)[0, 0] == 1


def test_confidence_falls_where_the_teacher_departs_from_the_target():
    term = HighFrequency(lambda: Interpolation("lanczos"))
    target = noise()
    enlarged = resampled(target, FACTOR * HEIGHT, FACTOR * WIDTH, "bilinear")
    assert torch.equal(term.confidence(enlarged, target), torch.ones(FACTOR * HEIGHT, FACTOR * WIDTH, 1))
    brighter = term.confidence(enlarged + 0.1, target)
    assert torch.allclose(brighter, torch.full_like(brighter, np.exp(-1.0)), rtol=1e-4)  # exp(-10 * 0.1), same slopes
    slope = torch.arange(FACTOR * WIDTH)[None, :, None] * 0.01
    sloped = term.confidence(enlarged + slope, target)
    assert sloped[20, 30].item() == pytest.approx(np.exp(-10 * 0.30 - 5 * 0.01), rel=1e-3)
    assert sloped.min() > 0 and sloped.max() <= 1


def test_the_truth_costs_nothing_and_a_blurred_one_does_with_a_gradient_towards_it():
    fine = smooth()
    target = resampled(fine, HEIGHT, WIDTH, "bicubic")
    term = HighFrequency(lambda: Oracle(fine))
    assert term(inputs(fine, target)).item() == pytest.approx(0.0, abs=2e-4)  # answers are kept in half precision
    blurred = averaged(fine, 9).requires_grad_()
    loss = term(inputs(blurred, target))
    loss.backward()
    better = (blurred - 0.5 * blurred.grad / blurred.grad.abs().max()).detach()
    assert loss > 1e-3 and blurred.grad.isfinite().all()
    assert term(inputs(better * 0.02 + blurred.detach() * 0.98, target)) < loss


def test_levels_do_not_matter_only_detail_does():
    fine = smooth()
    target = resampled(fine, HEIGHT, WIDTH, "bicubic")
    term = HighFrequency(lambda: Oracle(fine))
    assert term(inputs(fine + 0.3, target)).item() == pytest.approx(0.0, abs=2e-4)


def test_the_teacher_is_asked_once_per_image():
    teacher = Oracle(smooth())
    term = HighFrequency(lambda: teacher)
    for index in (0, 0, 1, 0):
        term(inputs(smooth(seed=1), index=index))
    assert teacher.asked == 2


def test_near_masked_pixels_nothing_counts():
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[5, 6] = False
    target = noise()
    target[5, 6] = float("nan")
    prediction = smooth(seed=2).requires_grad_()
    loss = HighFrequency(lambda: Interpolation("lanczos"))(inputs(prediction, target, mask))
    loss.backward()
    assert loss.isfinite() and prediction.grad.isfinite().all()
    assert prediction.grad[20:24, 24:28].abs().max() < prediction.grad.abs().max() * 0.5
    assert HighFrequency(lambda: Interpolation("lanczos"))(inputs(prediction, noise(), torch.zeros_like(mask))) == 0


def test_the_teacher_is_not_asked_before_its_stage():
    teacher = Oracle(smooth())
    term = Weighted(HighFrequency(lambda: teacher), 0.1, lambda progress: cosine(progress, 0.65, 0.95))
    assert term(inputs(smooth(), step=65)) == {} and teacher.asked == 0
    assert term(inputs(smooth(), step=66)) != {} and teacher.asked == 1


def test_preparing_asks_for_every_training_image_and_says_who_was_asked():
    teacher = Oracle(smooth())
    term = HighFrequency(lambda: teacher)
    assert term.prepare(make_scene(3), "thermal") == {"teacher": "the truth"}
    assert teacher.asked == 3
    term(inputs(smooth(), index=2))
    assert teacher.asked == 3


def test_another_factor_is_named():
    with pytest.raises(ValueError, match="2 times as fine as the training image, the loss expects 4; set both"):
        HighFrequency(lambda: Interpolation("lanczos"))(inputs(noise(24, 32)))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"inner": 2}, "odd sides of windows, the first smaller, got 2 and 7"),
        ({"outer": 1}, "odd sides of windows, the first smaller, got 1 and 1"),
        ({"gamma_pixel": -1.0}, "gamma_pixel and gamma_gradient must not be negative and factor at least 1, got -1.0"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        HighFrequency(lambda: Interpolation("lanczos"), **options)


# Teachers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", ["lanczos", "bicubic"])
def test_interpolation_is_a_teacher_that_must_be_chosen(kernel):
    teacher = load_teacher(kernel)
    expected = resampled(noise(), FACTOR * HEIGHT, FACTOR * WIDTH, kernel).clamp(0, 1)
    assert torch.equal(teacher(noise(), frame(), FACTOR), expected)
    assert teacher.description == f"{kernel} interpolation (no network)"


def test_without_a_teacher_the_error_says_what_to_give():
    with pytest.raises(SceneError, match="none is chosen. Give a file with a network .*SwinIR.*teacher=lanczos"):
        load_teacher(None)
    with pytest.raises(SceneError, match="there is no file or folder .*missing.pth. Give a file"):
        load_teacher("missing.pth")


@pytest.mark.parametrize("bits", [8, 16])
def test_enlarged_images_are_found_by_name_and_read_to_full_depth(tmp_path, bits):
    fine = (smooth()[..., 0].numpy() * (2**bits - 1)).round().astype(np.uint8 if bits == 8 else np.uint16)
    (tmp_path / "sub").mkdir()
    Image.fromarray(fine).save(tmp_path / "sub" / "000.png")
    teacher = load_teacher(str(tmp_path))
    teacher.check(frame(), FACTOR)
    answer = teacher(noise(), frame(), FACTOR)
    assert torch.allclose(answer[..., 0], torch.from_numpy(fine.astype(np.float32) / (2**bits - 1)))
    with pytest.raises(SceneError, match="no image for sub/001.JPG; it holds 1 images such as 000.png"):
        teacher.check(frame(1), FACTOR)


def test_an_enlarged_image_serves_one_training_image_alone(tmp_path):
    """Images of two cameras have one name each in folders of their own."""
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "000.png")
    teacher, left = load_teacher(str(tmp_path)), replace(frame(), name="left/000.png")
    teacher.check(left, FACTOR)
    teacher.check(left, FACTOR)
    with pytest.raises(
        SceneError, match=r"000.png would be that of left/000.png and of right/000.png: put enlarged images into"
    ):
        teacher.check(replace(frame(), name="right/000.png"), FACTOR)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / side / "000.png")
    teacher = load_teacher(str(tmp_path))
    for side in ("left", "right"):
        teacher.check(replace(frame(), name=f"{side}/000.png"), FACTOR)


def test_an_enlarged_image_of_the_wrong_size_is_refused_before_training(tmp_path):
    for index in range(2):
        Image.fromarray(np.zeros((40, 64), np.uint8)).save(tmp_path / f"{index:03d}.png")
    term = HighFrequency(lambda: load_teacher(str(tmp_path)))
    message = "000.png has 64 x 40 pixels, but 4 times the training image sub/000.JPG is 64 x 48"
    with pytest.raises(SceneError, match=message):
        term.prepare(make_scene(), "thermal")


@pytest.mark.parametrize(
    "low, high, told", [(25.0, 26.0, "from 25 to 26"), (-9.0, 1.0, "from -9"), (np.nan, 1.0, "from nan")]
)
def test_enlarged_images_in_celsius_are_no_white_teacher(tmp_path, low, high, told):
    fine = low + (high - low) * smooth()[..., 0].numpy()
    fine[0, :2] = low, high
    Image.fromarray(fine).save(tmp_path / "000.tif")
    with pytest.raises(SceneError, match=f"000.tif has values {told}.* encoded like the training images, 0 to 1"):
        load_teacher(str(tmp_path))(noise(), frame(), FACTOR)


def test_edges_of_an_enlarged_image_may_overshoot(tmp_path):
    fine = 1.2 * smooth()[..., 0].numpy() - 0.1
    Image.fromarray(fine).save(tmp_path / "000.tif")
    answer = load_teacher(str(tmp_path))(noise(), frame(), FACTOR)
    assert np.array_equal(answer[..., 0], fine.clip(0, 1))


@pytest.mark.parametrize("size", [0, 30, 400])
def test_a_truncated_image_of_a_teacher_is_named(tmp_path, size):
    Image.fromarray((smooth()[..., 0].numpy() * 255).astype(np.uint8)).save(tmp_path / "000.png")
    whole = (tmp_path / "000.png").read_bytes()
    assert len(whole) > 400
    (tmp_path / "000.png").write_bytes(whole[:size])
    term = HighFrequency(lambda: load_teacher(str(tmp_path)))
    with pytest.raises(SceneError, match=r"teacher image .*000.png cannot be read: .* Copy it again"):
        term.prepare(make_scene(1), "thermal")


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SceneError, match="the folder holds no image"):
        load_teacher(str(tmp_path))


def save_enlarger(path, factor=FACTOR):
    """A network that enlarges by repetition, as TorchScript or as an exported program."""
    network = torch.nn.Upsample(scale_factor=float(factor), mode="nearest")
    example = torch.rand(1, 3, HEIGHT, WIDTH)
    if path.suffix == ".pt2":
        torch.export.save(torch.export.export(network, (example,)), path)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(network, example).save(path)


@pytest.mark.parametrize("name, kind", [("net.pt", "TorchScript network"), ("net.pt2", "exported network")])
def test_a_network_from_a_file_is_asked_once_and_its_answer_kept(tmp_path, name, kind):
    save_enlarger(tmp_path / name)
    teacher = load_teacher(str(tmp_path / name), cache=str(tmp_path / "cache"), trust=True)
    assert teacher.description.startswith(f"{kind} in {name} (SHA-256 ")
    answer = teacher(noise(), frame(), FACTOR)
    expected = noise().repeat_interleave(FACTOR, 0).repeat_interleave(FACTOR, 1)
    assert torch.allclose(answer, expected, atol=1e-3)
    assert [path.suffix for path in (tmp_path / "cache").iterdir()] == [".npy"]
    again = load_teacher(str(tmp_path / name), cache=str(tmp_path / "cache"), trust=True)
    again.network = lambda planes: pytest.fail("the network was asked again")
    assert torch.equal(again(noise(), frame(), FACTOR), answer)  # a later run trains on the same bits
    with pytest.raises(pytest.fail.Exception):
        again(noise(seed=1), frame(), FACTOR)


@pytest.mark.parametrize("damage", ["empty", "cut", "other shape"])
def test_a_damaged_answer_in_the_cache_is_made_again(tmp_path, damage):
    save_enlarger(tmp_path / "net.pt")
    teacher = load_teacher(str(tmp_path / "net.pt"), cache=str(tmp_path / "cache"), trust=True)
    answer = teacher(noise(), frame(), FACTOR)
    (kept,) = (tmp_path / "cache").iterdir()
    whole = kept.read_bytes()
    if damage == "other shape":
        np.save(kept, np.zeros((2, 2, 1), np.float16))
    else:
        kept.write_bytes(whole[: len(whole) // 2 if damage == "cut" else 0])
    assert torch.equal(teacher(noise(), frame(), FACTOR), answer)
    assert kept.read_bytes() == whole and list(kept.parent.iterdir()) == [kept]


@pytest.mark.parametrize("full", [False, True])
def test_a_cache_that_cannot_be_written_costs_one_warning(tmp_path, monkeypatch, caplog, full):
    save_enlarger(tmp_path / "net.pt")
    (tmp_path / "file").write_text("no folder")
    cache = tmp_path / "cache" if full else tmp_path / "file" / "cache"
    if full:
        monkeypatch.setattr(np, "save", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    teacher = load_teacher(str(tmp_path / "net.pt"), cache=str(cache), trust=True)
    for seed in range(2):
        assert teacher(noise(seed=seed), frame(), FACTOR).shape == (FACTOR * HEIGHT, FACTOR * WIDTH, 1)
    (told,) = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert f"cannot be kept in {cache}" in told and "teacher.cache" in told
    assert not full or not list(cache.iterdir())


def test_jobs_that_share_a_cache_do_not_meet(tmp_path):
    """Each writes its own file beside the one that it becomes, and none sees half of one."""
    save_enlarger(tmp_path / "net.pt")
    teachers = [load_teacher(str(tmp_path / "net.pt"), cache=str(tmp_path / "cache"), trust=True) for _ in range(4)]

    def ask(teacher):
        return [teacher(noise(seed=seed), frame(), FACTOR) for seed in range(12)]

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(ask, teachers)
    assert all(torch.equal(a, b) for other in others for a, b in zip(other, first, strict=True))
    assert len(list((tmp_path / "cache").iterdir())) == 12


@pytest.mark.parametrize("mode", ["LA", "P", "1"])
def test_images_of_a_teacher_are_what_they_look_like(tmp_path, mode):
    pixels = np.full((12 * FACTOR, 16 * FACTOR), 51, np.uint8)
    pixels[:, ::2] = 255
    plain = Image.fromarray(pixels if mode != "1" else np.where(pixels > 100, 255, 0).astype(np.uint8))
    plain.convert(mode).save(tmp_path / "a.png")
    answer = load_teacher(str(tmp_path), cache=None)(noise(), replace(frame(), name="a.png"), FACTOR)
    assert np.allclose(answer[..., 0].numpy() * 255, np.asarray(plain), atol=1)


def test_a_network_for_another_factor_is_refused(tmp_path):
    save_enlarger(tmp_path / "net.pt", factor=2)
    teacher = load_teacher(str(tmp_path / "net.pt"), cache=None, trust=True)
    message = r"made \[1, 3, 24, 32\], but \[1, 3, 48, 64\] is needed; is it a network for factor 4\?"
    with pytest.raises(SceneError, match=message):
        teacher(noise(), frame(), FACTOR)


def test_files_that_hold_no_network_are_refused(tmp_path):
    (tmp_path / "text.pth").write_text("hello")
    with pytest.raises(SceneError, match="neither weights that torch can load safely nor TorchScript"):
        load_teacher(str(tmp_path / "text.pth"))
    torch.save({"weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(SceneError, match=r"holds no SwinIR for super-resolution \(found: weight\)"):
        load_teacher(str(tmp_path / "other.pth"))
    (tmp_path / "text.pt2").write_text("hello")
    with pytest.raises(SceneError, match="is no program of torch.export"):
        load_teacher(str(tmp_path / "text.pt2"), trust=True)


@pytest.mark.parametrize("name", ["net.pt", "net.pt2"])
def test_files_that_run_code_are_refused_unless_they_are_trusted(tmp_path, monkeypatch, name):
    save_enlarger(tmp_path / name)
    for loader in (torch.jit, torch.export):
        monkeypatch.setattr(loader, "load", lambda *_, **__: pytest.fail("its code was loaded"))
    with pytest.raises(SceneError, match=rf"{name} is no state dictionary, .* say so with trust=true"):
        load_teacher(str(tmp_path / name))


# SwinIR ---------------------------------------------------------------------------------------------------


def small(seed=0, **options):
    """A small network with random weights."""
    network = swinir.SwinIR(**({"dim": 12, "depths": (2, 2), "heads": 3, "window": 4} | options)).eval()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.2 * torch.randn(parameter.shape, generator=generator))
    return network


def test_the_small_model_has_as_many_parameters_as_the_released_one():
    network = swinir.SwinIR()
    assert sum(parameter.numel() for parameter in network.parameters()) == 929_628
    assert network.state_dict()["layers.3.residual_group.blocks.5.attn.relative_position_bias_table"].shape == (225, 6)


@pytest.mark.parametrize("size", [(8, 8), (5, 11), (1, 3), (2, 30), (13, 4)])
@pytest.mark.parametrize("options", [{}, {"direct": False}, {"scale": 3, "direct": False}, {"channels": 1, "scale": 2}])
def test_any_size_becomes_scale_times_as_large(size, options):
    network = small(**options)
    channels, scale = options.get("channels", 3), options.get("scale", 4)
    with torch.no_grad():
        fine = network(torch.rand(1, channels, *size))
    assert fine.shape == (1, channels, scale * size[0], scale * size[1]) and fine.isfinite().all()


def test_windows_go_there_and_back_and_shifts_keep_strangers_apart():
    image = torch.arange(2 * 8 * 12 * 3.0).reshape(2, 8, 12, 3)
    windows = swinir._windows(image, 4)
    assert torch.equal(windows[1], image[0, :4, 4:8]) and torch.equal(windows[6], image[1, :4, :4])
    assert torch.equal(swinir._from_windows(windows, 8, 12), image)
    mask = swinir._separated(8, 12, 4, 2).reshape(2, 3, 16, 16)
    assert mask[0, 0].abs().max() == 0  # nothing comes round into the first window
    last = mask[1, 2].reshape(4, 4, 4, 4)
    assert last[0, 0, 1, 1] == 0 and last[0, 0, 0, 2] == -100 and last[3, 3, 2, 2] == 0


def test_a_change_beyond_reach_changes_nothing():
    """Attention stays in windows: pixels move only as far as windows, shifts and convolutions carry them."""
    network = small(depths=(1,))  # one block without a shift
    image = torch.rand(1, 3, 24, 24)
    changed = image.clone()
    changed[..., 0, 0] = 1.0 - changed[..., 0, 0]
    with torch.no_grad():
        difference = (network(image) - network(changed)).abs().amax((0, 1))
    assert difference[:16, :16].max() > 0
    assert difference[40:, 40:].max() == 0
    shifted = small(depths=(2,))
    with torch.no_grad():
        reach = (shifted(image) - shifted(changed)).abs().amax((0, 1)).nonzero().max()
    assert reach > difference.nonzero().max()


def test_released_files_are_read_back_with_their_sizes(tmp_path):
    for options in ({}, {"scale": 2, "direct": False, "mlp_ratio": 4.0}, {"scale": 3, "channels": 1}):
        network = small(**options)
        state = network.state_dict()
        state["layers.0.residual_group.blocks.1.attn_mask"] = torch.zeros(4, 16, 16)  # kept in released files
        state["layers.0.residual_group.blocks.1.attn.relative_position_index"] = torch.zeros(16, 16)
        torch.save({"params": state}, tmp_path / "swinir.pth")
        teacher = load_teacher(str(tmp_path / "swinir.pth"), cache=None)
        image = torch.rand(1, options.get("channels", 3), 9, 7)
        with torch.no_grad():
            assert torch.equal(teacher.network(image), network(image))
        assert teacher.description.startswith("SwinIR in swinir.pth")


def test_a_grey_image_goes_through_three_channels_and_comes_back_grey(tmp_path):
    torch.save(small().state_dict(), tmp_path / "swinir.pth")
    teacher = load_teacher(str(tmp_path / "swinir.pth"), cache=None)
    answer = teacher(noise(), frame(), FACTOR)
    assert answer.shape == (FACTOR * HEIGHT, FACTOR * WIDTH, 1)
    assert answer.min() >= 0 and answer.max() <= 1


def test_weights_that_do_not_fit_together_are_refused(tmp_path):
    state = small().state_dict()
    state["conv_after_body.weight"] = torch.zeros(3, 3)
    torch.save(state, tmp_path / "broken.pth")
    with pytest.raises(SceneError, match="looks like SwinIR, but its tensors do not fit together"):
        load_teacher(str(tmp_path / "broken.pth"))
