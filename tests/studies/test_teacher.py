"""The recipe of a super-resolution teacher: what it learns from, that it learns, and that runs can use its file."""

from functools import partial

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.losses.swinir import SwinIR
from heatsplat.losses.teacher import load_teacher
from heatsplat.studies import teacher
from heatsplat.studies.teacher import images_of, made_small, patches, run, train

NETWORK = {"dim": 8, "depths": [2], "heads": 2, "window": 4}
OPTIONS = {
    "factor": 2, "steps": 12, "batch": 4, "patch": 8, "rate": 2e-3, "seed": 0,
    "network": NETWORK,
}  # fmt: skip
DATA = partial(Synthetic, size="tiny", frames=3)


def test_its_file_is_a_teacher(tmp_path):
    file = run(tmp_path, DATA, ["room_0", "room_1"], ["room_2"], **OPTIONS)
    assert file.name == "teacher_x2.pth"
    loaded = load_teacher(str(file), cache=None)
    image = DATA(scene="room_2").scene.train[0].thermal
    frame = Frame("0.png", 0, Camera(torch.eye(4), torch.eye(3), image.shape[1], image.shape[0]))
    assert loaded(image, frame, 2).shape == (2 * image.shape[0], 2 * image.shape[1], 1)
    page = (tmp_path / "teacher.md").read_text()
    assert "6 images of 2 scenes" in page and "teacher_x2.pth" in page
    assert {"bicubic", "lanczos", "network"} <= set(page.replace("|", " ").split())
    assert (tmp_path / "teacher.png").stat().st_size > 1000


def test_the_same_seed_gives_the_same_network(tmp_path):
    files = [run(tmp_path / str(i), DATA, ["room_0"], ["room_2"], **OPTIONS | {"steps": 3}) for i in range(2)]
    one, other = (torch.load(file, weights_only=True) for file in files)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_patches_of_both_resolutions_show_the_same():
    fine = images_of(DATA(scene="room_1"), 2)
    coarse = made_small(fine, 2)
    assert coarse.shape == (3, 1, 26, 32)
    for cut, small in patches(fine, coarse, 5, 3, 10, seed=1):
        assert cut.shape == (3, 1, 20, 20) and small.shape == (3, 1, 10, 10)
        inner = (..., slice(3, -3), slice(3, -3))  # the kernel reaches beyond the patch
        assert torch.allclose(made_small(cut, 2)[inner], small[inner], atol=1e-5)


def test_training_lowers_the_error():
    fine = images_of(DATA(scene="room_1"), 2)
    coarse = made_small(fine, 2)
    torch.manual_seed(0)
    model = SwinIR(scale=2, **OPTIONS["network"])

    def error():
        with torch.no_grad():
            return (model(coarse.expand(-1, 3, -1, -1)).mean(1) - fine[:, 0]).abs().mean().item()

    before = error()
    train(model, fine, coarse, steps=40, batch=4, patch=8, rate=5e-3, seed=0)
    assert error() < 0.4 * before


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scenes": []}, r"study.scenes=\[\] has nothing in it"),
        ({"held_out": []}, r"study.held_out=\[\] has nothing in it"),
        ({"held_out": ["no_room"]}, "no_room"),
        ({"steps": 0}, "study.steps must be a whole number, 1 or more, got 0"),
        ({"batch": "abc"}, "study.batch must be a whole number, 1 or more, got abc"),
        ({"factor": 0}, "study.factor must be a whole number"),
        ({"rate": "abc"}, "study.rate"),
        ({"rate": 0}, "study.rate must be above 0, got 0"),
        ({"network": NETWORK | {"heads": 5}}, "dim=8 channels .* study.network.heads=5: give a multiple of 5"),
        ({"network": NETWORK | {"heads": 0}}, "study.network.heads must be a whole number, 1 or more, got 0"),
        ({"network": NETWORK | {"depths": [2, "a"]}}, "study.network.depths must be a whole number"),
        ({"network": NETWORK | {"depths": []}}, r"study.network.depths=\[\] has nothing in it"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_learned(wrong, message, tmp_path, monkeypatch):
    monkeypatch.setattr(teacher, "train", None)
    if "held_out" not in wrong:
        monkeypatch.setattr(teacher, "images_of", lambda *_: pytest.fail("scenes were rendered"))
    with pytest.raises(ValueError, match=message):
        run(tmp_path, DATA, **{"scenes": ["room_0"], "held_out": "room_1"} | OPTIONS | wrong)


def test_scenes_that_tell_are_not_learned_from(tmp_path):
    with pytest.raises(SceneError, match="study.held_out names scenes that the network learns from: room_0"):
        run(tmp_path, DATA, ["room_0"], ["room_0"], **OPTIONS)
    with pytest.raises(SceneError, match="lower study.patch"):
        run(tmp_path, DATA, ["room_0"], ["room_1"], **OPTIONS | {"patch": 40})
