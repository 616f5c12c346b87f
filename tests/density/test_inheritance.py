"""What new Gaussians inherit, for every method: temperatures stay at all times, and the image changes least."""

import pytest
import torch
from helpers import OF_GAUSSIANS
from running import TINY

from heatsplat.composition import compose
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.runs.run import begin
from heatsplat.thermal.base import Query

ALONE = torch.tensor([0])
# Fields of place or of the direction of view, which are no property of a Gaussian: its children read them where they are.
PLACED = {
    "thermal3dgs", "ti3dgs", "hexplane_4dgs", "ntr_gaussian", "thermogs", "3dgs_ir", "mftg", "msmg", "ommg", "ravigs",
    "through_air", "physir",
}  # fmt: skip


@pytest.fixture(scope="module", params=OF_GAUSSIANS)
def lone(request, tmp_path_factory):
    """A module whose cloud is one Gaussian, nearly round and some pixels large, with heat and networks as if trained."""
    begun = begin(compose([*TINY, f"method={request.param}", "max_steps=100"]), tmp_path_factory.mktemp(request.param))
    module, scene = begun.module, begun.data.scene
    module.attach(scene)
    module.thermal.on_step(99)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        heat = [module.splats[name] for name in module.splats.names if name not in ("means", "label")]
        for tensor in [*heat, *module.thermal.parameters()]:
            tensor.add_(0.1 * torch.randn(tensor.shape, generator=generator))
    Cloud(module.splats).keep(torch.arange(len(module.splats)) == 7)
    with torch.no_grad():
        module.splats.means[:] = scene.bulk[0]
        frame = scene.train.frames[0]
        pixel = frame.camera.project(module.splats.means)[1] / frame.camera.K[0, 0]
        module.splats["log_scales"][:] = (torch.tensor([3.4, 3.6, 3.2]) * pixel).log()
        module.splats["opacity_logits"].zero_()
    return request.param, module


def at_three_times(module):
    frames = module.scene.train.frames
    return [frames[i] for i in (0, len(frames) // 2, len(frames) - 1)]


def rows_of(module) -> dict[str, torch.Tensor]:
    return Cloud(module.splats).rows(torch.arange(len(module.splats)))


def two(rows: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value.repeat(2, *[1] * (value.ndim - 1)) for name, value in rows.items()}


def become(module, rows: dict[str, torch.Tensor]) -> None:
    """The module's cloud has these Gaussians and no others."""
    cloud, count = Cloud(module.splats), len(module.splats)
    cloud.append(rows)
    cloud.keep(torch.arange(len(cloud)) >= count)


@torch.no_grad()
def emitted(module) -> torch.Tensor:
    """[3, N, C]"""
    found = []
    for frame in at_three_times(module):
        query = Query(None, frame.camera, frame.time_s, frame.frame_id)
        query = Query(None, frame.camera, frame.time_s, frame.frame_id, module.thermal.geometry(module.splats, query))
        found.append(module.thermal.features(module.splats, query))
    return torch.stack(found)


@torch.no_grad()
def images(module) -> tuple[torch.Tensor, torch.Tensor]:
    """Temperature (or colour) of what covers a pixel, features over alpha, [3, H, W, C]; and that times alpha."""
    module.smoothing.follow(module.splats.means, 0, 100, True)
    covers, shown = [], []
    for frame in at_three_times(module):
        output = module.render(frame)
        alpha = output.alpha.repeat_interleave(torch.tensor(module.thermal.opacity_channels), dim=0).permute(1, 2, 0)
        own = output.features - (1 - alpha) * module.background
        covers.append(torch.where(alpha > 0.02, own / alpha, torch.nan))
        shown.append(own)
    return torch.stack(covers), torch.stack(shown)


def test_temperatures_are_those_of_the_parent_at_every_time_and_place(lone):
    name, module = lone
    parent, before, (covers, shown) = rows_of(module), emitted(module), images(module)
    assert covers.isfinite().any(dim=(1, 2)).all()  # each time sees it
    try:
        Cloud(module.splats).split(ALONE, LongAxisSplit())
        split = rows_of(module)
        after, (covers_after, shown_after) = emitted(module), images(module)
        become(
            module,
            {key: value.repeat(2, *[1] * (value.ndim - 1)) for key, value in parent.items()}
            | {"means": split["means"]},
        )
        moved = emitted(module)
        torch.testing.assert_close(after, moved, rtol=1e-6, atol=1e-6)
        if name not in PLACED:
            torch.testing.assert_close(after, before.expand_as(after), rtol=1e-6, atol=1e-6)
        both = covers.isfinite() & covers_after.isfinite()
        assert (covers_after - covers)[both].abs().max() < (after - before).abs().max() + 1e-5

        def changed(rows) -> float:
            become(module, rows)
            return float((images(module)[1] - shown).norm())

        others = [changed(two(parent))]
        for seed in range(3):
            become(module, parent)
            others.append(changed(Adaptive._halves(Cloud(module.splats), ALONE, torch.Generator().manual_seed(seed))))
        assert float((shown_after - shown).norm()) < 0.7 * min(others)
    finally:
        become(module, parent)


def test_heat_is_inherited_bit_for_bit(lone):
    _, module = lone
    parent = rows_of(module)
    try:
        Cloud(module.splats).split(ALONE, LongAxisSplit())
        for name, rows in rows_of(module).items():
            if name not in ("means", "log_scales", "opacity_logits"):
                assert torch.equal(rows, parent[name].expand_as(rows)), name
    finally:
        become(module, parent)
