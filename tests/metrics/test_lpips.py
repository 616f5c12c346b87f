"""LPIPS against torchmetrics with the same backbone weights, and its refusal to invent a number."""

import pytest
import torch
from torch import nn

from heatsplat.metrics.lpips import FILES, MINIMUM_SIDE, Lpips, LpipsUnavailable, _features, find_backbone, load_lpips
from heatsplat.training.rng import generator_for


def random_backbone(net):
    """Weights of torchvision's names and shapes, made up: good for comparing implementations and nothing else."""
    generator = generator_for(0, 0, net)
    state = {}
    for name, value in _features(net).state_dict().items():
        scale = 1.0 if value.ndim == 1 else (2.0 / value[0].numel()) ** 0.5
        state[f"features.{name}"] = (
            scale * torch.randn(value.shape, generator=generator) * (0.1 if value.ndim == 1 else 1)
        )
    return state


def images(channels=3, side=64):
    generator = generator_for(0, 0, "lpips images")
    target = torch.rand(side, side + 8, channels, generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_agrees_with_torchmetrics(net, monkeypatch):
    from torchmetrics.functional.image import lpips as theirs

    state = random_backbone(net)

    def stack(name, pretrained=False):
        """torchvision's feature stack, which torchmetrics would import; its last pooling is not compared."""
        features = _features(net)
        features.load_state_dict({key.removeprefix("features."): value for key, value in state.items()})
        return nn.Sequential(*features, nn.MaxPool2d(2, 2))

    monkeypatch.setattr(theirs, "_get_tv_model_features", stack)
    reference = theirs._LPIPS(pretrained=True, net=net, pnet_rand=True)
    ours = Lpips(net, state)
    prediction, target = images()
    expected = reference(*(x.permute(2, 0, 1)[None] for x in (prediction, target)), normalize=True).item()
    assert expected > 1e-3
    assert ours(prediction, target) == pytest.approx(expected, rel=1e-5)
    assert net in ours.description


def test_one_channel_is_repeated_and_identical_images_score_zero():
    net = Lpips("alex", random_backbone("alex"))
    prediction, target = images(channels=1)
    assert net(prediction, target) == pytest.approx(net(prediction.repeat(1, 1, 3), target.repeat(1, 1, 3)), rel=1e-6)
    assert net(target, target) == 0.0


def test_masked_pixels_add_nothing():
    net = Lpips("alex", random_backbone("alex"))
    _, target = images(channels=1)
    mask = torch.ones(target.shape[:2], dtype=torch.bool)
    mask[20:30, 20:30] = False
    spoiled = target.clone()
    spoiled[20:30, 20:30] = 1.0
    assert net(target, spoiled) > 0
    assert net(target, spoiled, mask) == 0.0
    spoiled[20:30, 20:30] = float("nan")
    assert net(target, spoiled) == 0.0
    assert net(target, spoiled, torch.zeros_like(mask)) is None


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_smallest_image(net):
    score = Lpips(net, random_backbone(net))
    side = MINIMUM_SIDE[net]
    prediction, target = images(side=side)
    assert score(prediction[:side, :side], target[:side, :side]) > 0
    assert score(prediction[: side - 1], target[: side - 1]) is None


def test_without_weights_there_is_a_reason_and_no_number(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(LpipsUnavailable, match=f"Download https://download.pytorch.org/models/{FILES['alex']}"):
        load_lpips("alex")
    with pytest.raises(LpipsUnavailable, match="not at .*missing.pth"):
        load_lpips("vgg", tmp_path / "missing.pth")
    with pytest.raises(LpipsUnavailable, match="there are alex, vgg"):
        load_lpips("squeeze")


def test_weights_are_found_and_checked(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    hub = tmp_path / "checkpoints" / FILES["alex"]
    torch.save(random_backbone("alex"), hub)
    with pytest.raises(LpipsUnavailable, match="is damaged"):  # random weights under the hub's name
        find_backbone("alex")
    prediction, target = images()
    by_path = load_lpips("alex", hub)
    assert by_path(prediction, target) == Lpips("alex", random_backbone("alex"))(prediction, target)
    assert "SHA-256" in by_path.description
    with pytest.raises(LpipsUnavailable, match="not those of the net"):
        load_lpips("vgg", hub)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_lpips("alex", f"~/checkpoints/{hub.name}").source == by_path.source
    hub.write_bytes(b"no weights")
    with pytest.raises(LpipsUnavailable, match="cannot be read as weights"):
        load_lpips("alex", hub)
