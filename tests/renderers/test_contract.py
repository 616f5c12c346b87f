"""The renderer contract: the reference against a loop and finite differences, every backend against the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from helpers import ALL_RENDERERS
from torch import Tensor

from heatsplat.contracts import RenderOutput
from heatsplat.geometry.projection import look_at
from heatsplat.renderers import rasterization
from heatsplat.renderers.base import ALPHA_MAX, ALPHA_MIN, EPS2D, FOV_MARGIN, TRANSMITTANCE_MIN
from heatsplat.training.rng import generator_for

GRADIENTS = ("means", "quats", "scales", "opacities", "features", "background", "viewmat")


@dataclass(frozen=True, eq=False)
class Scene:
    """Arguments of one call, as float64 tensors on the CPU; ``background`` may be None."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    background: Tensor | None = None
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    output: RenderOutput
    gradients: dict[str, Tensor]

    def images(self) -> dict[str, Tensor]:
        output = self.output
        return {"features": output.features, "alpha": output.alpha, "depth": output.depth}


UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def camera_matrix(focal: float, width: int, height: int) -> Tensor:
    # Unequal focal lengths and an off-centre principal point, so that no axis can stand for the other.
    return torch.tensor([[focal, 0, 0.46 * width], [0, 1.1 * focal, 0.55 * height], [0, 0, 1]], dtype=torch.float64)


def plain_scene(
    count: int = 200, channels: tuple[int, ...] = (3,), seed: int = 0, width: int = 48, height: int = 40, **options: Any
) -> Scene:
    """Gaussians of a few pixels in front of a tilted camera, some of them beyond the border of the image."""
    generator = generator_for(seed, 0, "plain scene")

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    tensors = {
        "means": torch.cat([uniform(-2, 2, count, 2), uniform(-1.2, 1.2, count, 1)], dim=1),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": uniform(math.log(0.02), math.log(0.3), count, 3).exp(),
        "opacities": uniform(0.1, 0.95, len(channels), count),
        "features": uniform(0, 1, count, sum(channels)),
        "background": uniform(0, 1, sum(channels)),
    }
    eye = torch.tensor([0.7, -0.9, -4.0], dtype=torch.float64)
    viewmat = look_at(eye, torch.zeros_like(eye), torch.tensor([0.1, -1.0, 0.0], dtype=torch.float64))
    scene = Scene(
        **tensors, viewmat=viewmat, K=camera_matrix(1.1 * width, width, height), width=width, height=height,
        options={"modality_channels": channels, **options},
    )  # fmt: skip
    return rounded(scene)


def rounded(scene: Scene) -> Scene:
    """The scene with every number rounded to float32, so that all backends see the same one."""
    changed = {name: getattr(scene, name) for name in (*GRADIENTS, "K")}
    return replace(scene, **{name: x.float().double() for name, x in changed.items() if x is not None})


def facing(
    means: list, scales: Any, opacities: Any = 0.6, quats: Any = (0.9, 0.2, -0.3, 0.4), size: tuple[int, int] = (24, 20)
) -> Scene:
    """Gaussians [n] of one modality before an unmoved camera at the origin; single values hold for all of them.

    A single scale is that of an ellipsoid: a sphere has no gradient of rotation, only rounding noise."""
    means = torch.tensor(means, dtype=torch.float64).reshape(-1, 3)
    count = len(means)

    def rows(value: Any, width: int) -> Tensor:
        value = torch.as_tensor(value, dtype=torch.float64)
        return (value if value.ndim == 2 else value.expand(count, width)).clone()

    opacities = torch.as_tensor(opacities, dtype=torch.float64).expand(count).clone()
    features = torch.linspace(0.2, 1.0, count, dtype=torch.float64)[:, None] if count else torch.zeros(0, 1).double()
    scales = [scales, 0.7 * scales, 1.3 * scales] if isinstance(scales, float) else scales
    return rounded(
        Scene(
            means, rows(quats, 4), rows(scales, 3), opacities[None], features, torch.eye(4, dtype=torch.float64),
            camera_matrix(20.0, *size), *size, background=torch.tensor([0.3], dtype=torch.float64),
            options={"absgrad": True},
        )
    )  # fmt: skip


def loss(output: RenderOutput) -> Tensor:
    """All images under fixed random weights: a scalar whose gradient sees every pixel."""
    generator = generator_for(1, 0, "loss weights")
    images = [image for image in (output.features, output.alpha, output.depth) if image is not None]
    weights = [torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image) for image in images]
    return sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))


def run(backend: str, scene: Scene, dtype: torch.dtype | None = None, **options: Any) -> Result:
    """What a backend gives for a scene, back on the CPU as float64, with the gradients of a fixed random loss."""
    device = "cuda" if backend == "gsplat" else "cpu"
    dtype = dtype or torch.float32
    # The reference works on small tensors: on a busy machine two threads take four times as long as one. Numba changes
    # the number of OpenMP threads, which torch shares, so it is set before every call.
    torch.set_num_threads(1)
    leaves = {
        name: value.to(device, dtype, copy=True).requires_grad_()
        for name in GRADIENTS
        if (value := getattr(scene, name)) is not None
    }
    arguments = {"background": None, **leaves, **scene.options, **options}
    output = rasterization(
        arguments.pop("means"), arguments.pop("quats"), arguments.pop("scales"), arguments.pop("opacities"),
        arguments.pop("features"), arguments.pop("viewmat"), scene.K.to(device, dtype), scene.width, scene.height,
        backend=backend, **arguments,
    )  # fmt: skip
    loss(output).backward()
    gradients = {name: leaf.grad.double().cpu() for name, leaf in leaves.items()}
    means2d, ids = output.meta["means2d"], output.meta["visible_ids"]
    for name in ("grad", "absgrad"):
        if getattr(means2d, name, None) is not None:
            kept = torch.zeros_like(means2d)  # rows that were not seen are undefined in the contract
            kept[ids] = getattr(means2d, name)[ids]
            gradients[f"means2d.{name}"] = kept.double().cpu()
    meta = {key: value.detach().cpu() for key, value in output.meta.items()}
    depth = None if output.depth is None else output.depth.detach().double().cpu()
    return Result(
        RenderOutput(output.features.detach().double().cpu(), output.alpha.detach().double().cpu(), depth, meta),
        gradients,
    )


def oracle(scene: Scene, **options: Any) -> Result:
    return run("reference", scene, torch.float64, **options)


known = cache(oracle)  # what every backend is compared with


def relative(actual: Tensor, expected: Tensor) -> float:
    """Relative L2 error; 0 where both are zero."""
    return ((actual - expected).norm() / expected.norm().clamp(min=1e-300)).item() if expected.numel() else 0.0


def assert_close(actual: Result, expected: Result, image: float = 1e-4, gradient: float = 1e-4) -> None:
    errors = {name: relative(x, expected.images()[name]) for name, x in actual.images().items() if x is not None}
    assert max(errors.values()) < image, errors
    errors = {name: relative(x, expected.gradients[name]) for name, x in actual.gradients.items()}
    assert max(errors.values()) < gradient, errors
    assert set(actual.gradients) == set(expected.gradients)


def assert_finite(result: Result) -> None:
    everything = result.images() | result.gradients
    assert [name for name, x in everything.items() if x is not None and not x.isfinite().all()] == []


def runnable(backend: str) -> str:
    """The backend's name; skips the test where it cannot run here."""
    if backend == "gsplat":
        if not torch.cuda.is_available():
            pytest.skip("the gsplat renderer needs a CUDA device")
        pytest.importorskip("gsplat", reason="the gsplat renderer needs: pip install -e '.[gsplat]'")
    try:
        import_module(f"heatsplat.renderers.{backend}")
    except ModuleNotFoundError as error:
        if error.name != f"heatsplat.renderers.{backend}":
            raise
        pytest.skip(f"this checkout has no heatsplat.renderers.{backend}")
    return backend


@pytest.fixture(autouse=True)
def torch_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.gpu) if name == "gsplat" else name for name in ALL_RENDERERS]
)
def backend(request: pytest.FixtureRequest) -> str:
    return runnable(request.param)


# The reference itself ------------------------------------------------------------------------------------------------


@cache
def loop(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Features, alpha and depth by a loop over pixels and Gaussians with explicit inverses, and the relative distance
    of the nearest value from a threshold, which finite differences must not cross."""
    channels, antialiased = scene.options["modality_channels"], scene.options.get("antialiased", False)
    eps2d = scene.options.get("eps2d", EPS2D)
    viewmat, K = scene.viewmat.numpy(), scene.K.numpy()
    focal, principal = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    size = np.array([scene.width, scene.height])
    margin = FOV_MARGIN * 0.5 * size / focal
    splats, near = [], math.inf
    for i in range(len(scene.means)):
        point = viewmat[:3, :3] @ scene.means[i].numpy() + viewmat[:3, 3]
        w, x, y, z = (scene.quats[i] / scene.quats[i].norm()).tolist()
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * skew + 2 * skew @ skew
        covariance = rotation @ np.diag(scene.scales[i].numpy() ** 2) @ rotation.T
        slope = point[:2] / point[2]
        low, high = -principal / focal - margin, (size - principal) / focal + margin
        near = min(near, np.abs(slope - low).min(), np.abs(slope - high).min())
        slope = np.clip(slope, low, high)
        jacobian = np.array(
            [[focal[0], 0, -focal[0] * slope[0]], [0, focal[1], -focal[1] * slope[1]]]
        ) / point[2] @ viewmat[:3, :3]  # fmt: skip
        flat = jacobian @ covariance @ jacobian.T
        blurred = flat + eps2d * np.eye(2)
        factor = math.sqrt(np.linalg.det(flat) / np.linalg.det(blurred)) if antialiased else 1.0
        splats.append((point[2], i, focal * point[:2] / point[2] + principal, np.linalg.inv(blurred), factor))
    splats.sort(key=lambda splat: splat[:2])

    shape = (scene.height, scene.width)
    features, depth = np.zeros((*shape, sum(channels))), np.zeros(shape)
    alpha = np.zeros((len(channels), *shape))
    starts = np.cumsum([0, *channels])
    for m, (row, column) in ((m, pixel) for m in range(len(channels)) for pixel in np.ndindex(shape)):
        part = slice(starts[m], starts[m + 1])
        left = 1.0
        for z, i, centre, inverse, factor in splats:
            offset = np.array([column + 0.5, row + 0.5]) - centre
            raw = scene.opacities[m, i].item() * factor * math.exp(-0.5 * offset @ inverse @ offset)
            near = min(near, abs(raw / ALPHA_MIN - 1), abs(raw / ALPHA_MAX - 1))
            if raw < ALPHA_MIN:
                continue
            a = min(ALPHA_MAX, raw)
            near = min(near, abs(left * (1 - a) / TRANSMITTANCE_MIN - 1))
            if left * (1 - a) <= TRANSMITTANCE_MIN:
                break
            features[row, column, part] += left * a * scene.features[i, part].numpy()
            depth[row, column] += left * a * z if m == 0 else 0.0
            left *= 1 - a
        alpha[m, row, column] = 1 - left
        features[row, column, part] += left * scene.background[part].numpy()
    return features, alpha, depth, near


SMALL = [
    plain_scene(30, (3,), seed=3, width=16, height=12),
    plain_scene(30, (2, 1), seed=10, width=16, height=12, antialiased=True),
    plain_scene(30, (1,), seed=27, width=16, height=12, antialiased=True, eps2d=0.1),
]


def opaque(scene: Scene) -> Scene:
    """The scene with larger and opaque Gaussians: alphas are clamped and pixels finish early."""
    return replace(scene, scales=4 * scene.scales, opacities=0.6 + 0.4 * scene.opacities.round())


SMALL_AND_OPAQUE = [*SMALL, *map(opaque, SMALL)]


@pytest.mark.parametrize("scene", SMALL_AND_OPAQUE)
def test_reference_equals_a_loop_over_pixels(scene):
    features, alpha, depth, _ = loop(scene)
    output = oracle(scene).output
    np.testing.assert_allclose(output.features, features, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(output.alpha, alpha, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(output.depth, depth, rtol=1e-11, atol=1e-12)


def test_the_opaque_scenes_finish_pixels_early():
    for scene in map(opaque, SMALL):
        assert oracle(scene).output.alpha.max() > 1 - 2 * TRANSMITTANCE_MIN


@pytest.mark.parametrize("scene", SMALL_AND_OPAQUE)
def test_reference_gradients_equal_finite_differences(scene):
    *_, margin = loop(scene)
    assert margin > 1e-4, "the scene is too near a threshold for finite differences; change its seed"
    gradients = oracle(scene).gradients

    @torch.no_grad()
    def value_of(scene: Scene) -> float:
        rows = (scene.means, scene.quats, scene.scales, scene.opacities, scene.features, scene.viewmat, scene.K)
        arguments = {"background": scene.background, "backend": "reference", **scene.options}
        return loss(rasterization(*rows, scene.width, scene.height, **arguments)).item()

    step = 1e-7
    for name in GRADIENTS:
        value = getattr(scene, name)
        for direction in range(6):
            along = torch.randn(value.shape, generator=generator_for(direction, 0, name), dtype=torch.float64)
            if name == "viewmat":
                along[3] = 0
            along = along / along.norm()
            ahead, back = (value_of(replace(scene, **{name: value + s * step * along})) for s in (1, -1))
            numeric, exact = (ahead - back) / (2 * step), (gradients[name] * along).sum().item()
            assert numeric == pytest.approx(exact, rel=1e-5, abs=1e-6 * gradients[name].norm().item()), name


def test_reference_computes_in_the_type_of_its_inputs():
    single, double = run("reference", SMALL[0], torch.float32), oracle(SMALL[0])
    assert 1e-9 < relative(single.output.features, double.output.features) < 1e-5


def test_reference_splits_pixels_without_a_trace(monkeypatch):
    whole = oracle(SMALL[1], absgrad=True)
    monkeypatch.setattr("heatsplat.renderers.reference.PAIRS", 500)
    parts = oracle(SMALL[1], absgrad=True)
    assert torch.equal(parts.output.features, whole.output.features)
    assert_close(parts, whole, 1e-15, 1e-13)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_reference_runs_on_cuda():
    leaves = [getattr(SMALL[0], name).cuda() for name in (*GRADIENTS[:5], "viewmat", "K")]
    output = rasterization(*leaves, 16, 12, background=SMALL[0].background.cuda(), backend="reference")
    assert relative(output.features.cpu(), oracle(SMALL[0]).output.features) < 1e-12


# Every backend against the reference ---------------------------------------------------------------------------------

# The CPU renderer compiles its kernels once for each layout: channels, depth, absolute gradients. Two layouts are used
# here alone, one channel and two modalities with everything; the others are those of training runs.
ONE, TWO, BARE = {"channels": (1,), "absgrad": True}, {"channels": (3, 1), "absgrad": True}, {"depth": False}
PLAIN = {
    "one channel": plain_scene(**ONE),
    "one channel, antialiased": plain_scene(**ONE, antialiased=True),
    "one channel, antialiased, less blur": plain_scene(**ONE, antialiased=True, eps2d=0.1),
    "one channel, more blur": plain_scene(**ONE, eps2d=0.7),
    "rgb": plain_scene(channels=(3,), **BARE),
    "rgb, antialiased": plain_scene(channels=(3,), **BARE, antialiased=True),
    "four channels": plain_scene(channels=(4,), **BARE),
    "rgb and thermal": plain_scene(**TWO),
    "rgb and thermal, antialiased": plain_scene(**TWO, antialiased=True),
    "width and height of no tile": plain_scene(**ONE, width=37, height=29),
}


@pytest.mark.parametrize("name", PLAIN)
def test_images_and_gradients_of_plain_scenes(backend, name):
    assert_close(run(backend, PLAIN[name]), known(PLAIN[name]))


WIDE = plain_scene(**ONE, antialiased=True, seed=5)
INTRINSICS = {
    "one channel": PLAIN["one channel"],
    "rgb and thermal, antialiased": PLAIN["rgb and thermal, antialiased"],
    # Gaussians far outside of the image, whose Jacobian is that of the limit of sight, which depends on the intrinsics.
    "beyond the field of view": replace(WIDE, means=2.5 * WIDE.means, scales=4 * WIDE.scales),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_the_gradient_of_the_intrinsics(backend, name):
    scene, found = INTRINSICS[name], []
    if backend == "gsplat":
        pytest.skip("gsplat gives no gradient to intrinsics")
    for used, dtype in ((backend, torch.float32), ("reference", torch.float64)):
        rows = [
            getattr(scene, name).to(dtype) for name in ("means", "quats", "scales", "opacities", "features", "viewmat")
        ]
        K = scene.K.to(dtype, copy=True).requires_grad_()
        loss(rasterization(*rows, K, scene.width, scene.height, backend=used, **scene.options)).backward()
        found.append(K.grad.double())
    assert relative(*found) < 1e-4
    assert (found[1][[0, 1, 0, 1], [0, 1, 2, 2]].abs() > 1e-3 * found[1].norm()).all()


@pytest.mark.parametrize("name", ["one channel", "rgb and thermal"])
def test_sizes_and_opacities_may_be_given_as_they_are_trained(backend, name):
    """Logarithms and logits, some of them out of the range of their activations, with gradients of their own."""
    scene = PLAIN[name]
    logits = scene.opacities.logit().clamp(-90, 90)
    logits[:, 3], logits[0, 5] = -100.0, 30.0
    raw = rounded(replace(scene, scales=scene.scales.log(), opacities=logits))
    actual, expected = run(backend, raw, raw=True), oracle(raw, raw=True)
    assert_close(actual, expected)
    activated = replace(raw, scales=raw.scales.exp(), opacities=raw.opacities.sigmoid())
    assert relative(expected.output.features, oracle(activated).output.features) < 1e-12


@pytest.mark.parametrize("name", ["one channel", "rgb and thermal"])
def test_absolute_screen_gradients(backend, name):
    # Sums of |gradient| over pixels and modalities: gsplat composites each modality on its own and cannot do otherwise.
    # That they are right is tested above; here, that they are what they claim to be.
    gradients = run(backend, PLAIN[name]).gradients
    summed, absolute = gradients["means2d.grad"].abs(), gradients["means2d.absgrad"]
    assert (absolute >= summed * (1 - 1e-4) - 1e-6).all()
    assert absolute.sum() > 1.2 * summed.sum()  # gradients of different pixels do oppose each other


def test_without_absgrad_there_is_none(backend):
    assert "means2d.absgrad" not in run(backend, PLAIN["rgb"]).gradients


def test_absolute_screen_gradients_are_taken_pixel_by_pixel():
    scene = plain_scene(20, (1,), width=10, height=8)
    rows = [getattr(scene, name) for name in ("quats", "scales", "opacities", "features", "viewmat", "K")]
    output = rasterization(scene.means.clone().requires_grad_(), *rows, 10, 8, backend="reference", absgrad=True)
    means2d, expected = output.meta["means2d"], torch.zeros(20, 2, dtype=torch.float64)
    for pixel in np.ndindex(8, 10):
        expected += torch.autograd.grad(output.features[pixel].sum(), means2d, retain_graph=True)[0].abs()
    means2d.absgrad.zero_()
    output.features.sum().backward()
    torch.testing.assert_close(means2d.absgrad, expected, rtol=1e-12, atol=1e-14)


def test_no_background_is_black(backend):
    scene = PLAIN["rgb and thermal"]
    black = run(backend, replace(scene, background=torch.zeros(4, dtype=torch.float64)))
    none = run(backend, replace(scene, background=None))
    assert relative(none.output.features, black.output.features) < 1e-7
    assert_close(none, oracle(replace(scene, background=None)))


def test_depth_only_where_it_is_asked_for(backend):
    scene = PLAIN["one channel"]
    with_depth, without = run(backend, scene), run(backend, scene, depth=False, absgrad=False)
    assert without.output.depth is None
    assert relative(without.output.features, with_depth.output.features) < 1e-6
    assert_close(without, oracle(scene, depth=False, absgrad=False))


def test_shapes_and_meta(backend):
    scene = PLAIN["rgb and thermal"]
    output, expected = run(backend, scene).output, oracle(scene).output
    assert output.features.shape == (40, 48, 4)
    assert output.alpha.shape == (2, 40, 48)
    assert output.depth.shape == (40, 48)
    meta = output.meta
    assert meta["radii"].shape == (200, 2)
    assert meta["radii"].dtype == torch.int32
    assert meta["visible_ids"].dtype == torch.int64
    assert torch.equal(meta["visible_ids"], (meta["radii"] > 0).all(1).nonzero().squeeze(1))
    assert torch.equal(meta["visible_ids"], expected.meta["visible_ids"])
    assert 20 < len(meta["visible_ids"]) < 200
    ids = meta["visible_ids"]
    assert relative(meta["means2d"][ids].double(), expected.meta["means2d"][ids]) < 1e-5
    # Rounding may move an extent across a whole number of pixels, no further.
    assert (meta["radii"] - expected.meta["radii"]).abs().max() <= 1


def test_one_opacity_set_may_be_flat(backend):
    scene = PLAIN["rgb"]
    flat = run(backend, replace(scene, opacities=scene.opacities[0]))
    assert torch.equal(flat.output.features, run(backend, scene).output.features)
    assert flat.gradients["opacities"].shape == (200,)


def test_features_may_be_a_function_of_the_visible_ids(backend):
    scene = PLAIN["rgb and thermal"]
    calls = []
    table = scene.features.to("cuda" if backend == "gsplat" else "cpu", torch.float32).requires_grad_()

    def emit(ids: Tensor) -> Tensor:
        calls.append(ids)
        return table[ids]

    def features_by(argument) -> RenderOutput:
        to = {"device": table.device, "dtype": torch.float32}
        rows = (getattr(scene, name).to(**to) for name in ("means", "quats", "scales", "opacities"))
        return rasterization(
            *rows, argument, scene.viewmat.to(**to), scene.K.to(**to), 48, 40, backend=backend, **scene.options
        )

    called, given = features_by(emit), features_by(table)
    assert len(calls) == 1
    assert calls[0].dtype == torch.int64
    assert torch.equal(calls[0], called.meta["visible_ids"])
    assert torch.equal(called.features, given.features)
    by_call, by_table = (torch.autograd.grad(o.features.square().sum(), table)[0] for o in (called, given))
    assert by_call.abs().sum() > 0
    torch.testing.assert_close(by_call, by_table)


def test_screen_gradients_are_those_of_moved_centres(backend):
    # Moving the principal point moves every centre, and nothing else where no slope is at its margin.
    scene = plain_scene(30, **ONE, width=16, height=12)
    scene = rounded(replace(scene, means=0.4 * scene.means))
    for axis in (0, 1):
        shift = torch.zeros(3, 3, dtype=torch.float64)
        shift[axis, 2] = 1e-6
        ahead, back = (loss(oracle(replace(scene, K=scene.K + sign * shift)).output) for sign in (1, -1))
        summed = run(backend, scene).gradients["means2d.grad"][:, axis].sum().item()
        assert summed == pytest.approx((ahead - back).item() / 2e-6, rel=1e-4)


@pytest.mark.parametrize("name", ["one channel", "rgb and thermal, antialiased"])
def test_the_same_bits_on_every_run(backend, name):
    if backend == "gsplat":
        pytest.skip("gsplat adds gradients with atomics, in no fixed order")
    first, second = (run(backend, PLAIN[name]) for _ in range(2))
    for key, image in (first.images() | first.gradients).items():
        assert torch.equal(image, (second.images() | second.gradients)[key]), key
    for key, value in first.output.meta.items():
        assert torch.equal(value, second.output.meta[key]), key


# Hard cases ----------------------------------------------------------------------------------------------------------


def assert_unseen(result: Result, hidden: list[int]) -> None:
    """These Gaussians are not visible and have no gradient at all."""
    assert not set(hidden) & set(result.output.meta["visible_ids"].tolist())
    assert (result.output.meta["radii"][hidden] == 0).all()
    for name in ("means", "quats", "scales", "features"):
        assert (result.gradients[name][hidden] == 0).all(), name
    assert (result.gradients["opacities"][:, hidden] == 0).all()


def test_near_plane(backend):
    scene = facing([[0.002, 0.001, 0.011], [0.0, 0.0, 0.009], [-0.003, 0.0, 0.03], [0.02, 0.01, 0.1]], 0.002)
    actual = run(backend, scene)
    assert_finite(actual)
    assert_unseen(actual, [1])
    assert actual.output.meta["visible_ids"].tolist() == [0, 2, 3]
    assert_close(actual, oracle(scene), 1e-4, 1e-3)


def test_near_and_far_can_be_chosen(backend):
    scene = facing([[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0]], 0.2)
    actual = run(backend, scene, near=1.5, far=2.5)
    assert_unseen(actual, [0, 2])
    assert_close(actual, oracle(scene, near=1.5, far=2.5))


def test_what_lies_behind_a_finished_pixel_has_no_gradient(backend):
    """Fine opaque dots finish all pixels around one of a block; a last dot finishes that one, and no other takes it."""
    around = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    dots = [*around, *around, (0, 0), (0, 0)]
    pixels = 5.5 + torch.tensor(dots, dtype=torch.float64)
    depths = 1.0 + 0.01 * torch.arange(len(dots), dtype=torch.float64)[:, None]
    K = facing([], 1.0, size=(16, 16)).K
    centers = torch.cat([(pixels - K[:2, 2]) / K.diagonal()[:2] * depths, depths], dim=1).tolist()
    scales = torch.tensor([*(1e-4 * depths[:, 0]), 1.4], dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.7, 1.3])
    opacities = [*[0.9999] * (len(dots) - 2), 0.5, 0.9999, 0.5]
    scene = facing([*centers, [0.0, 0.0, 1.4]], scales, opacities, size=(16, 16))
    assert_close(run(backend, scene), oracle(scene))


def test_behind_the_camera(backend):
    scene = facing([[0, 0, -2.0], [0.1, 0, 0.0], [0, 0, 2.0], [0.0, 0.2, -1e-6]], 0.3)
    actual = run(backend, scene)
    assert_finite(actual)
    assert_unseen(actual, [0, 1, 3])
    assert_close(actual, oracle(scene))


def test_nothing_in_view(backend):
    scene = facing([[0, 0, -2.0], [900.0, 0, 2.0], [0, -900.0, 1.0]], 0.3, [0.9, 0.9, 0.001])
    actual = run(backend, scene)
    assert_unseen(actual, [0, 1, 2])
    assert (actual.output.features == np.float32(0.3)).all()
    assert (actual.output.alpha == 0).all()
    assert (actual.output.depth == 0).all()
    assert (actual.gradients["viewmat"] == 0).all()
    assert relative(actual.gradients["background"], oracle(scene).gradients["background"]) < 1e-5


def test_nothing_in_view_with_a_function(backend):
    asked = []

    def emit(ids: Tensor) -> Tensor:
        asked.append(ids)
        return torch.zeros(len(ids), 3, device=ids.device)

    device = "cuda" if backend == "gsplat" else "cpu"
    scene = facing([[0, 0, -2.0]], 0.3)
    rows = (getattr(scene, name).to(device, torch.float32) for name in ("means", "quats", "scales", "opacities"))
    cameras = (scene.viewmat.to(device), scene.K.to(device))
    output = rasterization(*rows, emit, *cameras, 24, 20, backend=backend, depth=False)
    assert output.features.shape == (20, 24, 3)
    assert [len(ids) for ids in asked] == [0]


def test_no_gaussian(backend):
    scene = facing([], 0.3)
    actual = run(backend, scene)
    assert (actual.output.features == np.float32(0.3)).all()
    assert (actual.output.alpha == 0).all()
    assert actual.gradients["means"].shape == (0, 3)
    assert actual.output.meta["radii"].shape == (0, 2)
    assert actual.output.meta["visible_ids"].shape == (0,)
    assert (actual.gradients["viewmat"] == 0).all()


def test_one_gaussian_on_one_pixel(backend):
    scene = facing([[0.01, -0.02, 2.0]], 0.05, size=(1, 1))
    actual = run(backend, scene)
    assert actual.output.features.shape == (1, 1, 1)
    assert actual.output.meta["visible_ids"].tolist() == [0]
    assert_close(actual, oracle(scene))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(
    ("shape", "scales"),
    {"needles": (0.5, 5e-7, 5e-7), "pancakes": (0.4, 0.5, 5e-7), "flat discs": (0.5, 0.4, 0.0)}.items(),
)
def test_needles_and_pancakes(backend, shape, scales, antialiased):
    generator = generator_for(2, 0, "needles")
    quats = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    means = torch.rand(30, 3, generator=generator, dtype=torch.float64) * 2 - torch.tensor([1.0, 1.0, -2.0])
    scene = facing(means.tolist(), scales, 0.7, quats)
    actual, expected = run(backend, scene, antialiased=antialiased), oracle(scene, antialiased=antialiased)
    assert_finite(actual)
    if shape == "needles" and antialiased:  # a needle has no area on the screen
        assert actual.output.alpha.max() < 0.05
        return
    assert relative(actual.output.features, expected.output.features) < 1e-3
    for name in ("means", "opacities", "features"):
        assert relative(actual.gradients[name], expected.gradients[name]) < 1e-2, name


@pytest.mark.parametrize("scales", [(50.0, 1e-3, 1e-3), (5.0, 4.0, 1e-4)], ids=["needles", "pancakes"])
def test_all_gradients_of_axis_ratios_of_50_000(backend, scales):
    generator = generator_for(3, 0, "needles")
    quats = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    means = torch.rand(30, 3, generator=generator, dtype=torch.float64) * 2 - torch.tensor([1.0, 1.0, -2.0])
    scene = facing(means.tolist(), scales, 0.7, quats)
    # gsplat forms covariances in float32, in which a ratio of 50,000 squared leaves no digit of the short axes.
    few_digits = backend == "gsplat" and scales[0] > 10
    assert_close(run(backend, scene), oracle(scene), *((2e-3, 4e-2) if few_digits else (1e-4, 1e-2)))


@pytest.mark.parametrize("backend", ["reference", "cpu"])  # gsplat's float32 covariances leave few digits of such
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("length", [50.0, 1e3, 1e5])
def test_all_gradients_of_needles_that_reach_far_beyond_the_image(backend, length, antialiased):
    """What they have in the image says next to nothing of their length, and rounding must not say more."""
    generator = generator_for(3, 0, "needles")
    quats = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    means = torch.rand(30, 3, generator=generator, dtype=torch.float64) * 2 - torch.tensor([1.0, 1.0, -2.0])
    scene = facing(means.tolist(), (length, 0.05, 0.03), 0.7, quats)
    actual = run(backend, scene, antialiased=antialiased)
    assert_close(actual, oracle(scene, antialiased=antialiased), 1e-5, 1e-4)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("scale", [1e12, 1e30, math.inf])
def test_gaussians_whose_determinant_no_float_holds_are_not_seen_on_a_processor(scale, antialiased):
    means = [[0, 0, 2.0], [0.3, 0.2, 3.0], [-0.3, 0.1, 2.5], [0.1, -0.1, 0.02]]
    scales = torch.tensor([[0.2, 0.1, 0.3]] * 4).double()
    scales[[0, 3]] = scale
    actual = run("cpu", facing(means, scales, 0.4), antialiased=antialiased)
    assert_finite(actual)
    assert_unseen(actual, [0, 3])


def test_discs_seen_from_the_edge(backend):
    # Discs in planes through the camera: the projection is a line, its determinant is 0 without the blur.
    for antialiased in (False, True):
        scene = facing([[0, 0, 2.0], [0, 0, 3.0]], [[0.3, 0.0, 0.3], [0.0, 0.3, 0.3]], quats=(1.0, 0.0, 0.0, 0.0))
        actual = run(backend, scene, antialiased=antialiased)
        assert_finite(actual)
        assert_close(actual, oracle(scene, antialiased=antialiased))
        assert (actual.output.alpha.max() == 0) == antialiased


@pytest.mark.parametrize("scale", [1e-7, 1e3])
def test_tiny_and_huge_gaussians(backend, scale):
    scene = facing([[0, 0, 2.0], [0.3, 0.2, 3.0], [5.0, -5.0, 1.0], [0.1, -0.1, 0.02]], scale, 0.4)
    actual, expected = run(backend, scene), oracle(scene)
    assert_finite(actual)
    assert relative(actual.output.features, expected.output.features) < 1e-4
    assert relative(actual.gradients["opacities"], expected.gradients["opacities"]) < 1e-3


def test_far_beyond_the_field_of_view(backend):
    # Large Gaussians whose centres lie where the Jacobian is held at the margin.
    scene = facing([[4.0, 0.3, 1.0], [-5.0, 1.0, 1.5], [0.2, 5.0, 2.0], [0.1, -6.0, 2.0]], 2.0)
    actual = run(backend, scene)
    assert len(actual.output.meta["visible_ids"]) == 4
    assert_close(actual, oracle(scene), 1e-4, 1e-3)


def test_a_zero_quaternion_hides_its_gaussian(backend):
    quats = [[1.0, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.3, 0.0, -1.0, 0.0]]
    scene = facing([[0, 0, 2.0], [0.1, 0, 1.0], [0.2, 0.1, 3.0]], [[0.2, 0.3, 0.1]] * 3, quats=quats)
    for antialiased in (False, True):
        actual = run(backend, scene, antialiased=antialiased)
        assert_finite(actual)
        assert_unseen(actual, [1])
        assert_close(actual, oracle(scene, antialiased=antialiased))


def test_quaternions_of_any_length(backend):
    scene = plain_scene(40, **ONE)
    lengths = torch.logspace(-6, 6, 40, dtype=torch.float64)[:, None]
    scaled = rounded(replace(scene, quats=scene.quats * lengths))
    actual = run(backend, scaled)
    assert relative(actual.output.features, oracle(scene).output.features) < 1e-4
    expected = oracle(scaled).gradients["quats"]
    assert relative(actual.gradients["quats"] * lengths, expected * lengths) < 1e-3


def test_opacity_logits_of_80(backend):
    logits = torch.tensor([80.0, -80.0, 80.0, -80.0], dtype=torch.float64)
    scene = facing([[0, 0, 2.0], [0.1, 0, 1.0], [0.2, 0.1, 3.0], [0, 0.1, 1.5]], 0.2, logits.sigmoid())
    actual = run(backend, scene)
    assert_finite(actual)
    assert_unseen(actual, [1, 3])
    assert_close(actual, oracle(scene))


def test_no_gradient_where_alpha_is_clamped(backend):
    # One opaque Gaussian so large that every pixel is at the clamp.
    actual = run(backend, facing([[0, 0, 2.0]], 500.0, 1.0))
    assert (actual.output.alpha - ALPHA_MAX).abs().max() < 1e-6
    for name in ("quats", "scales", "opacities", "means2d.grad"):
        assert (actual.gradients[name] == 0).all(), name
    assert (actual.gradients["features"] != 0).all()


def test_two_thousand_coincident_layers(backend):
    scene = facing([[0.0, 0.0, 2.0]] * 2000, 0.2, 0.05)
    actual = run(backend, scene)
    assert_finite(actual)
    assert_close(actual, oracle(scene), 1e-4, 1e-3)
    # Closed form: a pixel takes layers until its transmittance would fall to the limit, or until they end.
    layer = oracle(facing([[0.0, 0.0, 2.0]], 0.2, 0.05)).output.alpha
    layers = torch.floor(math.log(TRANSMITTANCE_MIN) / torch.log1p(-layer)).clamp(max=2000)
    expected = torch.where(layer > 0, 1 - (1 - layer) ** layers, 0.0)
    assert 100 < layers.min() < 2000 == layers.max()
    torch.testing.assert_close(actual.output.alpha, expected, rtol=0, atol=2e-5)


def test_equal_depths_are_in_order_of_index(backend):
    means = [[0.02 * i, -0.01 * i, 2.0] for i in range(8)]
    scene = facing(means, 0.2, 0.7)
    actual, turned = run(backend, scene), run(backend, replace(scene, features=scene.features.flip(0)))
    assert_close(actual, oracle(scene))
    centre = (10, 11)
    assert actual.output.features[centre].item() < 0.45  # the first in front: low features
    assert turned.output.features[centre].item() > 0.75


def test_below_the_opacity_cut_nothing_is_seen(backend):
    scene = facing([[0, 0, 2.0], [0.1, 0, 3.0]], 0.2, 0.0039)  # just below 1/255
    actual = run(backend, scene)
    assert_unseen(actual, [0, 1])
    assert_finite(actual)


def test_extents_reach_to_the_opacity_cut(backend):
    # Spheres on the axis, whose alpha falls to 1/255 at a distance that is known.
    opacities = torch.tensor([0.9, 0.3, 0.05, 0.006, 0.004], dtype=torch.float64)
    scene = facing([[0.0, 0.0, 2.0]] * 5, [0.4] * 3, opacities)
    for axis, focal in enumerate((20.0, 22.0)):
        deviation = math.sqrt((0.4 * focal / 2) ** 2 + EPS2D)
        expected = (deviation * (2 * (255 * opacities).log()).sqrt()).ceil()
        assert run(backend, scene).output.meta["radii"][:, axis].tolist() == expected.tolist()


def test_a_gaussian_beyond_the_border_is_seen_by_its_tail(backend):
    # Its centre lies so far left of the image that only the first column has an alpha above the cut.
    deviation = math.sqrt((0.05 * 20 / 2) ** 2 + EPS2D)
    reach = deviation * math.sqrt(2 * math.log(255 * 0.9))
    x = 0.5 + 0.02 - reach
    scene = facing([[2 * (x - 0.46 * 24) / 20, 2 * (10.5 - 11.0) / 22, 2.0]], 0.0, 0.9)
    scene = rounded(replace(scene, scales=torch.tensor([[0.05, 0.05, 0.0]], dtype=torch.float64), quats=UPRIGHT))
    alpha = run(backend, scene).output.alpha[0]
    assert alpha[10, 0].item() == pytest.approx(0.9 * math.exp(-0.5 * ((reach - 0.02) / deviation) ** 2), rel=1e-3)
    assert (alpha[:, 1:] == 0).all()


def test_a_gaussian_may_be_opaque_in_one_modality_only(backend):
    scene = plain_scene(40, **TWO)
    opacities = scene.opacities.clone()
    opacities[0, ::2], opacities[1, 1::2] = 0.001, 0.002
    scene = rounded(replace(scene, opacities=opacities))
    actual = run(backend, scene)
    assert_close(actual, oracle(scene))
    for m in (0, 1):  # each modality is what it would be alone
        part = slice(0, 3) if m == 0 else slice(3, 4)
        alone = replace(
            scene, opacities=opacities[m : m + 1], features=scene.features[:, part], background=scene.background[part]
        )
        alone = oracle(alone, modality_channels=(part.stop - part.start,))
        assert relative(actual.output.features[..., part], alone.output.features) < 1e-4


def test_bounds_never_cut_what_counts(backend):
    # Faint Gaussians of every shape: the reference looks at every pixel, so a tight bound would show.
    scene = plain_scene(150, **ONE, seed=5)
    scene = rounded(replace(scene, opacities=torch.logspace(-2.38, -0.5, 150, dtype=torch.float64)[None]))
    actual, expected = run(backend, scene), oracle(scene)
    assert (actual.output.alpha - expected.output.alpha).abs().quantile(0.999) < 1e-5
    assert (actual.output.alpha - expected.output.alpha).abs().max() < 0.6 * ALPHA_MIN


def test_coordinates_of_a_million(backend):
    scene = plain_scene(50, **ONE)
    away = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    viewmat = scene.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ away
    actual = run(backend, rounded(replace(scene, means=scene.means + away, viewmat=viewmat)))
    assert_finite(actual)


# Bad arguments -------------------------------------------------------------------------------------------------------

BAD = {
    "quats": (torch.zeros(5, 3), r"quats must have shape \[5, 4\], got \[5, 3\]"),
    "scales": (torch.zeros(4, 3), r"scales must have shape \[5, 3\], got \[4, 3\]"),
    "opacities": (torch.zeros(4), r"opacities must have shape \[5\] or \[M, 5\], got \[4\]"),
    "features": (torch.zeros(3, 1), r"features must have shape \[5, C\], got \[3, 1\]"),
    "viewmats": (torch.eye(3), r"viewmats and Ks must be \[4, 4\] and \[3, 3\], got \[3, 3\] and \[3, 3\]"),
    "width": (0, "image must have pixels, got 0 x 20"),
    "modality_channels": ((3, 1), r"modality_channels \(3, 1\) must name 1 counts"),
    "means": (torch.zeros(5, 3).half(), "Gaussians must be float32 or float64, got means of torch.float16"),
    "background": (
        torch.zeros(2).double(),
        "background must be like means, torch.float32 on cpu, got torch.float64 on cpu",
    ),
    "signs": (torch.ones(4), r"signs must have shape \[5\], got \[4\]"),
    "far": (0.001, "near must be 0 or more, and far beyond it, got near 0.01 and far 0.001"),
    "Ks": (
        torch.tensor([[20.0, 0.5, 12.0], [0, 20, 10], [0, 0, 1]]),
        r"Ks has a skew of 0.5 \(its \[0, 1\]\), which no renderer has",
    ),
    "backend": ("cuda", "unknown renderer backend 'cuda'; there are reference, cpu, gsplat and auto"),
}


OF_OTHER_TYPES = [
    ({"means": np.zeros((5, 3), np.float32)}, "means must be a tensor, got numpy.ndarray: torch.as_tensor makes one"),
    ({"means": torch.tensor(1.0)}, r"means must have shape \[0, 3\], got \[\]"),
    ({"opacities": None}, "opacities must be a tensor, got NoneType"),
    ({"background": 0.3}, "background must be a tensor, got float"),
    ({"viewmats": np.eye(4)}, "viewmats must be a tensor, got numpy.ndarray"),
    ({"Ks": np.eye(3)}, "Ks must be a tensor, got numpy.ndarray"),
    ({"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None]}, r"one camera per call, such as viewmats\[0\], Ks\[0\]"),
    ({"viewmats": torch.full((4, 4), torch.nan)}, "viewmats has NaN or infinite values"),
    ({"viewmats": look_at(torch.tensor([1.0, 2, 3]), torch.zeros(3), torch.tensor([0.0, 0, 1])).T}, "is it transposed, as"),
    ({"Ks": torch.zeros(3, 3)}, r"Ks needs fx and fy above 0 pixels \(its \[0, 0\] and \[1, 1\]\), got 0 and 0"),
    ({"Ks": torch.tensor([[20.0, 0, torch.nan], [0, 20, 10], [0, 0, 1]])}, r"of finite numbers, got \[\[20.0, 0.0, nan\]"),
    ({"Ks": torch.tensor([[torch.inf, 0, 12.0], [0, 20, 10], [0, 0, 1]])}, "of finite numbers, got"),
    ({"Ks": camera_matrix(20.0, 24, 20).T}, r"Ks must be \[\[fx, 0, cx\], \[0, fy, cy\], \[0, 0, 1\]\] of finite numbers"),
    ({"near": -1.0}, "near must be 0 or more, and far beyond it, got near -1.0"),
    ({"width": 24.0}, "width and height must be whole numbers of pixels, got 24.0 and 20"),
]  # fmt: skip


def arguments(**changed: Any) -> dict[str, Any]:
    plain = {
        "means": torch.zeros(5, 3) + torch.tensor([0.0, 0.0, 2.0]), "quats": torch.ones(5, 4),
        "scales": torch.full((5, 3), 0.1), "opacities": torch.full((5,), 0.5), "features": torch.ones(5, 2),
        "viewmats": torch.eye(4), "Ks": camera_matrix(20.0, 24, 20), "width": 24, "height": 20, "backend": "reference",
    }  # fmt: skip
    return plain | changed


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named(name):
    value, message = BAD[name]
    rasterization(**arguments())
    with pytest.raises(ValueError, match=message):
        rasterization(**arguments(**{name: value}))


@pytest.mark.parametrize(("changed", "message"), OF_OTHER_TYPES)
def test_arguments_of_other_types_and_cameras_that_are_none_are_named(changed, message):
    with pytest.raises(ValueError, match=message):
        rasterization(**arguments(**changed))


def test_sizes_of_numpy_are_whole_numbers():
    found = rasterization(**arguments(width=np.int64(24), height=np.int64(20)))
    assert torch.equal(found.features, rasterization(**arguments()).features)


def test_gsplat_refuses_to_leave_the_intrinsics_without_a_gradient():
    K = camera_matrix(20.0, 24, 20).requires_grad_()
    with pytest.raises(ValueError, match="gsplat gives no gradient to Ks"):
        rasterization(**arguments(Ks=K, backend="gsplat"))


def test_two_opacity_sets_need_their_channels():
    with pytest.raises(ValueError, match=r"2 opacity sets need modality_channels, such as \(3, 1\)"):
        rasterization(**arguments(opacities=torch.full((2, 5), 0.5)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"modality_channels": (3,)}, "modality_channels"),
        ({"background": torch.zeros(3)}, "background"),
        ({"features": lambda ids: torch.ones(len(ids) + 1, 2, device=ids.device)}, "features"),
    ],
)
def test_features_that_do_not_fit(backend, changed, message):
    device = "cuda" if backend == "gsplat" else "cpu"
    wrong = {key: x.to(device) if isinstance(x, Tensor) else x for key, x in arguments(**changed).items()}
    with pytest.raises(ValueError, match=message):
        rasterization(**wrong | {"backend": backend})


def test_auto_takes_the_reference_for_float64():
    double = {key: x.double() if isinstance(x, Tensor) else x for key, x in arguments().items()}
    output = rasterization(**double | {"backend": "auto"})
    assert torch.equal(output.features, rasterization(**double).features)
