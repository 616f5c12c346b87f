"""Learned perceptual image patch similarity, without torchvision.

torchmetrics ships the small linear heads (version 0.1); the backbone's ImageNet weights must be put on the machine by
hand. Without them there is no LPIPS: a number from random weights would look like one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from heatsplat.metrics.valid import valid_pixels

# Per net: the feature stack ("M" is a pooling, numbers are output channels), the layers whose output is compared, the
# smallest image side that survives the poolings, and torchvision's file.
ALEX = (64, "M", 192, "M", 384, 256, 256)
VGG = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
MINIMUM_SIDE = {"alex": 31, "vgg": 16}
FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}

# ImageNet's mean and deviation for inputs in [-1, 1] (Zhang et al., scaling layer).
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


class LpipsUnavailable(RuntimeError):
    """LPIPS cannot be computed here. The message says why and what to install."""


def _features(net: str) -> nn.Sequential:
    """The convolutional stack of a net with torchvision's numbering of layers, weights not yet loaded."""
    layers: list[nn.Module] = []
    channels = 3
    for entry in ALEX if net == "alex" else VGG:
        if entry == "M":
            layers.append(nn.MaxPool2d(3, 2) if net == "alex" else nn.MaxPool2d(2, 2))
            continue
        if net == "alex" and not layers:
            conv = nn.Conv2d(channels, entry, 11, stride=4, padding=2)
        elif net == "alex" and channels == 64:
            conv = nn.Conv2d(channels, entry, 5, padding=2)
        else:
            conv = nn.Conv2d(channels, entry, 3, padding=1)
        layers += [conv, nn.ReLU()]
        channels = entry
    return nn.Sequential(*layers)


def find_backbone(net: str, path: str | Path | None = None) -> Path:
    """The file of the backbone's weights: ``path`` where given, else torchvision's file in torch's hub folder.

    Raises:
        LpipsUnavailable: there is no such file, or the hub's file is not the one its name promises.
    """
    if net not in FILES:
        raise LpipsUnavailable(f"LPIPS net '{net}' is not known; there are {', '.join(FILES)}")
    found = Path(path).expanduser() if path is not None else Path(torch.hub.get_dir()) / "checkpoints" / FILES[net]
    if not found.is_file():
        raise LpipsUnavailable(
            f"LPIPS({net}) needs the backbone's ImageNet weights, which are not at {found}. Download "
            f"https://download.pytorch.org/models/{FILES[net]} to that place, or give callbacks.metrics.lpips_weights=FILE."
        )
    if path is None:
        expected = found.stem.rsplit("-", 1)[1]
        actual = file_digest(found)
        if actual != expected:
            raise LpipsUnavailable(
                f"LPIPS({net}): {found} is damaged, its SHA-256 begins with {actual} and not {expected}. Download it "
                f"again from https://download.pytorch.org/models/{FILES[net]}"
            )
    return found


def file_digest(path: Path) -> str:
    """First eight hexadecimal digits of a file's SHA-256, which torchvision puts into its file names."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:8]


def load_lpips(net: str = "alex", path: str | Path | None = None) -> Lpips:
    """LPIPS with weights from disk. Raises LpipsUnavailable, with the reason, where they cannot be had."""
    found = find_backbone(net, path)
    try:
        state = torch.load(found, map_location="cpu", weights_only=True)
        return Lpips(net, state, source=f"{found.name} (SHA-256 {file_digest(found)})")
    except LpipsUnavailable:
        raise
    except Exception as error:  # torch.load raises half a dozen types on a file that is no checkpoint
        raise LpipsUnavailable(f"LPIPS({net}): {found} cannot be read as weights of the net: {error}") from error


class Lpips(nn.Module):
    """LPIPS of two images.

    Args:
        net: "alex" or "vgg".
        backbone: torchvision's state dict of the whole net or of its ``features``.
        source: where the weights came from, for the result's description.

    Raises:
        LpipsUnavailable: the state dict does not fit the net.
    """

    def __init__(self, net: str, backbone: Mapping[str, Tensor], source: str = "given weights") -> None:
        super().__init__()
        self.net = net
        self.source = source
        self.features = _features(net)
        try:
            self.features.load_state_dict(
                {key.removeprefix("features."): value for key, value in backbone.items() if "classifier" not in key}
            )
        except RuntimeError as error:
            raise LpipsUnavailable(f"LPIPS({net}): the weights are not those of the net: {error}") from error
        (package,) = find_spec("torchmetrics").submodule_search_locations  # loading it takes seconds
        folder = Path(package) / "functional" / "image" / "lpips_models"
        # The heads were saved on a GPU: without map_location they do not load on a machine that has none.
        heads = torch.load(folder / f"{net}.pth", map_location="cpu", weights_only=True)
        self.heads = nn.ParameterList(heads[f"lin{i}.model.1.weight"] for i in range(len(TAPS[net])))
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None])
        self.requires_grad_(False).eval()

    @property
    def description(self) -> str:
        """What a value of this object is, for result tables."""
        return (
            f"LPIPS, net {self.net}, heads v0.1, {self.source}; inputs scaled from [0, 1] to [-1, 1], one channel "
            "repeated to three"
        )

    def _activations(self, image: Tensor) -> list[Tensor]:
        """Unit-length activations after the compared layers of an image [H, W, C] in [0, 1]."""
        x = ((2 * image.permute(2, 0, 1).expand(3, -1, -1) - 1) - self.shift) / self.scale
        x = x[None]
        out = []
        for i, layer in enumerate(self.features):
            x = layer(x)
            if i in TAPS[self.net]:
                out.append(x / (x.square().sum(1, keepdim=True) + 1e-8).sqrt())
        return out

    @torch.no_grad()
    def forward(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
        """LPIPS of two images, 0 for identical ones; None where no pixel counts or the image is too small for the net.

        Pixels that do not count are given one value in both images, so that they add nothing of their own; the mean is
        still over the whole image, so a score under a large mask is smaller than one without.

        Args:
            prediction, target: [H, W, C] in [0, 1], C = 1 or 3.
            mask: [H, W] bool, True where a pixel counts.

        Source: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric (2018), Eq. 1.
        """
        valid = valid_pixels(prediction, target, mask)
        if not valid.any() or min(valid.shape) < MINIMUM_SIDE[self.net]:
            return None
        fill = target[valid].mean()
        images = [torch.where(valid[..., None], image, fill).to(self.shift) for image in (prediction, target)]
        pairs = zip(self._activations(images[0]), self._activations(images[1]), self.heads, strict=True)
        return sum(F.conv2d((a - b).square(), head).mean().item() for a, b, head in pairs)
