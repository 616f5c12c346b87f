"""What the gsplat backend does around gsplat's kernels, tested without a GPU by plain stand-ins for the four kernels.

The stand-ins have the signatures, shapes and habits of gsplat 1.5.3: rows that are not seen hold garbage, absolute
gradients are left on the tensor that was passed in. The kernels themselves are tested by test_contract.py on a GPU.
"""

import builtins
import gc
import inspect
import math
import sys
import weakref
from types import ModuleType

import pytest
import torch

from heatsplat.geometry.projection import project_gaussians
from heatsplat.renderers import gsplat as backend
from heatsplat.renderers import rasterization
from heatsplat.renderers.base import ALPHA_MAX, ALPHA_MIN, FOV_MARGIN, TRANSMITTANCE_MIN
from heatsplat.training.rng import generator_for

WIDTH, HEIGHT, COUNT = 20, 18, 40


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d=0.3, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, packed=False, sparse_grad=False, calc_compensations=False, camera_model="pinhole", opacities=None,
):  # fmt: skip
    count = len(means)
    assert count > 0, "gsplat divides by the number of Gaussians"
    assert covars is None and not packed and quats.shape == (count, 4) and scales.shape == (count, 3)
    assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and opacities.shape == (count,)
    z = means @ viewmats[0, 2, :3] + viewmats[0, 2, 3]
    keep = (z >= near_plane) & (z <= far_plane) & (opacities >= ALPHA_MIN)
    ids = keep.nonzero().squeeze(1)
    screen = project_gaussians(
        means[ids], quats[ids], scales[ids], viewmats[0], Ks[0], width, height, eps2d, FOV_MARGIN
    )
    p, q, r = screen.whitening.unbind(1)
    conics = torch.stack([p * p, -p * p * q, p * p * q * q + r * r], dim=1)
    strength = opacities[ids] * (screen.compensation.detach() if calc_compensations else 1.0)
    reach = (2 * (strength / ALPHA_MIN).log()).sqrt()
    extent = (reach[:, None] * screen.variances.detach().sqrt()).ceil()
    size = torch.tensor([width, height])
    inside = ((screen.means + extent > 0) & (screen.means - extent < size) & (extent > 0)).all(1)

    def spread(rows, fill):
        return torch.full((count, *rows.shape[1:]), fill, dtype=rows.dtype).index_copy(0, ids[inside], rows[inside])[
            None
        ]

    garbage = math.nan
    return (
        spread(extent.nan_to_num().to(torch.int32), 0), spread(screen.means, garbage), spread(screen.depths, garbage),
        spread(conics, garbage), spread(screen.compensation, 0.0) if calc_compensations else None,
    )  # fmt: skip


def isect_tiles(
    means2d, radii, depths, tile_size, tile_width, tile_height, sort=True, segmented=False, packed=False, n_images=None,
    image_ids=None, gaussian_ids=None,
):  # fmt: skip
    assert means2d.shape == (1, COUNT, 2) and radii.shape == (1, COUNT, 2) and depths.shape == (1, COUNT)
    assert (tile_size, tile_width, tile_height, packed) == (16, 2, 2, False)
    seen = (radii[0] > 0).all(1).nonzero().squeeze(1)
    order = seen[depths[0].detach()[seen].argsort(stable=True)].to(torch.int32)
    return radii[0, :, 0], order.to(torch.int64), order


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    assert isect_ids.dtype == torch.int64 and n_images == 1
    return torch.zeros(1, tile_height, tile_width, dtype=torch.int32)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets, flatten_ids,
    backgrounds=None, masks=None, packed=False, absgrad=False,
):  # fmt: skip
    channels = colors.shape[-1]
    assert means2d.shape == (1, COUNT, 2) and conics.shape == (1, COUNT, 3) and colors.shape == (1, COUNT, channels)
    assert opacities.shape == (1, COUNT) and isect_offsets.shape == (1, 2, 2) and not packed and channels <= 32
    assert backgrounds is None or backgrounds.shape == (1, channels)
    ids = flatten_ids.long()
    ys, xs = torch.meshgrid(torch.arange(image_height) + 0.5, torch.arange(image_width) + 0.5, indexing="ij")
    pixels = torch.stack([xs, ys], dim=-1).view(-1, 1, 2)
    centres = means2d[0][ids].expand(len(pixels), -1, 2)
    if absgrad and centres.requires_grad:
        owner = weakref.ref(means2d)

        def leave(grad):
            owner().absgrad = torch.zeros(1, COUNT, 2).index_copy(1, ids, grad.abs().sum(0)[None])

        centres.register_hook(leave)
    dx, dy = (centres - pixels).unbind(-1)
    a, b, c = conics[0][ids].unbind(1)
    alpha = (opacities[0][ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    alpha = torch.where(torch.cumprod(1 - alpha, 1) > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones(len(pixels), 1), after], dim=1)
    image = (alpha * before[:, :-1]) @ colors[0][ids]
    left = before[:, -1:]
    if backgrounds is not None:
        image = image + left * backgrounds
    shape = (1, image_height, image_width, -1)
    return image.view(shape), (1 - left).view(shape)


@pytest.fixture
def stand_ins(monkeypatch):
    module = ModuleType("gsplat")
    for function in (fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels):
        setattr(module, function.__name__, function)
    compiled = ModuleType("gsplat.cuda._backend")
    compiled._C = object()
    for part in (module, ModuleType("gsplat.cuda"), compiled):
        monkeypatch.setitem(sys.modules, part.__name__, part)
    monkeypatch.setattr(backend, "check", lambda inputs: None)


def scene(channels):
    """Leaves and the camera; number 3 has a zero quaternion, number 5 is behind the camera, 7 is too faint."""
    generator = generator_for(0, 0, "stand-ins")

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    means = torch.cat([uniform(-1.5, 1.5, COUNT, 2), uniform(2.0, 4.0, COUNT, 1)], dim=1)
    quats, scales = torch.randn(COUNT, 4, generator=generator), uniform(0.05, 0.4, COUNT, 3)
    opacities = uniform(0.2, 0.9, len(channels), COUNT)
    means[5, 2], quats[3], opacities[:, 7] = -1.0, 0.0, 0.001
    tensors = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities,
        "features": uniform(0, 1, COUNT, sum(channels)), "background": uniform(0, 1, sum(channels)),
        "viewmats": torch.eye(4),
    }  # fmt: skip
    K = torch.tensor([[16.0, 0, 9], [0, 17, 10], [0, 0, 1]])
    return tensors, K


def rendered(name, channels, absgrad=True, used=slice(None), **options):
    tensors, K = scene(channels)
    leaves = {key: value.clone().requires_grad_() for key, value in tensors.items()}
    output = rasterization(
        **leaves, Ks=K, width=WIDTH, height=HEIGHT, backend=name, absgrad=absgrad, modality_channels=channels, **options
    )
    images = [output.features[..., used], output.alpha] + ([] if output.depth is None else [output.depth])
    weight = generator_for(0, 0, "weights")
    sum((image * torch.randn(image.shape, generator=weight)).sum() for image in images).backward()
    return output, {key: leaf.grad for key, leaf in leaves.items()}


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("channels", [(1,), (3, 1), (2, 1, 1)])
def test_equals_the_reference(stand_ins, channels, antialiased):
    (actual, gradients), (expected, exact) = (
        rendered(name, channels, antialiased=antialiased) for name in ("gsplat", "reference")
    )
    for name in ("features", "alpha", "depth"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=1e-4, atol=1e-5)
    for name, gradient in gradients.items():
        assert (gradient - exact[name]).norm() < 1e-4 * exact[name].norm(), name
    ids = actual.meta["visible_ids"]
    assert torch.equal(ids, expected.meta["visible_ids"])
    assert not {3, 5, 7} & set(ids.tolist())
    assert torch.equal(actual.meta["radii"], expected.meta["radii"])
    means2d, wanted = actual.meta["means2d"], expected.meta["means2d"]
    torch.testing.assert_close(means2d.grad[ids], wanted.grad[ids], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(means2d.absgrad[ids], wanted.absgrad[ids], rtol=1e-3, atol=1e-3)


def test_many_channels_are_composited_in_groups(stand_ins):
    (actual, gradients), (expected, exact) = (rendered(name, (70,), absgrad=False) for name in ("gsplat", "reference"))
    torch.testing.assert_close(actual.features, expected.features, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(actual.depth, expected.depth, rtol=1e-4, atol=1e-5)
    assert (gradients["means"] - exact["means"]).norm() < 1e-4 * exact["means"].norm()


def test_features_by_function_see_visible_ids_only(stand_ins):
    tensors, K = scene((2,))
    table = tensors.pop("features").requires_grad_()
    asked = []

    def emit(ids):
        asked.append(ids)
        return table[ids]

    outputs = [
        rasterization(**tensors, features=features, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat")
        for features in (emit, table)
    ]
    assert len(asked) == 1
    assert torch.equal(asked[0], outputs[0].meta["visible_ids"])
    assert torch.equal(outputs[0].features, outputs[1].features)
    by_call, by_table = (torch.autograd.grad(output.features.square().sum(), table)[0] for output in outputs)
    torch.testing.assert_close(by_call, by_table)


def test_no_background_and_no_depth(stand_ins):
    tensors, K = scene((3, 1))
    del tensors["background"]
    actual, expected = (
        rasterization(**tensors, Ks=K, width=WIDTH, height=HEIGHT, backend=name, depth=False, modality_channels=(3, 1))
        for name in ("gsplat", "reference")
    )
    assert actual.depth is None
    torch.testing.assert_close(actual.features, expected.features, rtol=1e-4, atol=1e-5)


def test_a_modality_without_loss_leaves_no_absolute_gradient(stand_ins):
    tensors, K = scene((3, 1))
    tensors["means"].requires_grad_()
    gradients = {}
    for name in ("gsplat", "reference"):
        output = rasterization(
            **tensors, Ks=K, width=WIDTH, height=HEIGHT, backend=name, absgrad=True, modality_channels=(3, 1)
        )
        output.features[..., 3].sum().backward()
        gradients[name] = output.meta["means2d"].absgrad[output.meta["visible_ids"]]
    torch.testing.assert_close(gradients["gsplat"], gradients["reference"], rtol=1e-3, atol=1e-3)


def test_an_empty_cloud_never_reaches_gsplat(stand_ins):
    tensors, K = scene((1,))
    tensors |= {name: tensors[name][:0] for name in ("means", "quats", "scales", "features")}
    tensors["opacities"] = tensors["opacities"][:, :0]
    output = rasterization(**tensors, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat")
    assert (output.features == tensors["background"]).all()


@pytest.mark.parametrize("backward", [False, True])
def test_the_graph_is_freed_with_the_output(stand_ins, backward):
    tensors, K = scene((3, 1))
    tensors["means"].requires_grad_()
    output = rasterization(
        **tensors, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat", absgrad=True, modality_channels=(3, 1)
    )
    if backward:
        output.features.sum().backward()
    traces = [weakref.ref(output.meta["means2d"]), *map(weakref.ref, output.meta["means2d"].parts)]
    del output
    gc.collect()
    assert [trace() for trace in traces] == [None] * 3


def test_missing_gsplat_says_how_to_get_it(monkeypatch):
    plain_import = builtins.__import__

    def without_gsplat(name, *rest):
        if name == "gsplat":
            raise ModuleNotFoundError("No module named 'gsplat'", name="gsplat")
        return plain_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_gsplat)
    tensors, K = scene((1,))
    with pytest.raises(ImportError, match=r"No module named 'gsplat'.*pip install -e '\.\[gsplat\]'"):
        rasterization(**tensors, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat")


def test_gsplat_without_compiled_kernels_says_what_is_missing(stand_ins, monkeypatch):
    monkeypatch.setattr(sys.modules["gsplat.cuda._backend"], "_C", None)
    tensors, K = scene((1,))
    with pytest.raises(ImportError, match="no CUDA toolkit to compile them with.*nvcc.*docs.gsplat.studio/whl"):
        rasterization(**tensors, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat")


@pytest.mark.parametrize(("dtype", "name"), [(torch.float32, "torch.float32"), (torch.float64, "torch.float64")])
def test_tensors_must_be_on_cuda(monkeypatch, dtype, name):
    monkeypatch.setattr(backend, "load", lambda: None)
    tensors, K = scene((1,))
    tensors = {key: value.to(dtype) for key, value in tensors.items()}
    message = f"needs float32 tensors on a CUDA device, got {name} on cpu; .* renderer=cpu"
    with pytest.raises(ValueError, match=message):
        rasterization(**tensors, Ks=K, width=WIDTH, height=HEIGHT, backend="gsplat")


@pytest.mark.parametrize("stand_in", [fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels])
def test_stand_ins_take_what_gsplat_takes(stand_in):
    gsplat = pytest.importorskip("gsplat", reason="compares with the installed gsplat")
    theirs = inspect.signature(getattr(gsplat, stand_in.__name__)).parameters
    ours = inspect.signature(stand_in).parameters
    assert [(p.name, p.default) for p in ours.values()] == [(p.name, p.default) for p in theirs.values()][: len(ours)]
