"""Every renderer on clouds of sound and broken Gaussians in one, and on images of extreme shapes.

tests/renderers looks at each hard case by itself; here they meet, and are asked for the same bits on every run.
"""

from dataclasses import replace

import pytest
import torch
from draws import generator
from helpers import ALL_RENDERERS
from hypothesis import given, settings
from hypothesis import strategies as st
from renderers.test_contract import Scene, assert_finite, facing, oracle, relative, rounded, run, runnable

COUNT = 60


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.gpu) if name == "gsplat" else name for name in ALL_RENDERERS]
)
def backend(request) -> str:
    return runnable(request.param)


def logarithmic(low: float, high: float, random: torch.Generator, *shape: int) -> torch.Tensor:
    return low * (high / low) ** torch.rand(*shape, generator=random, dtype=torch.float64)


def sound(seed: int) -> Scene:
    """Plain Gaussians before the camera, with opacities that differ."""
    random = generator(seed)
    means = torch.rand(COUNT, 3, generator=random, dtype=torch.float64) * torch.tensor([2.0, 2.0, 3.0]) + torch.tensor(
        [-1.0, -1.0, 1.0]
    )
    scales = logarithmic(0.02, 0.4, random, COUNT, 3)
    quats = torch.randn(COUNT, 4, generator=random, dtype=torch.float64)
    opacities = torch.rand(COUNT, generator=random, dtype=torch.float64) * 0.8 + 0.1
    return facing(means.tolist(), scales, opacities, quats)


# What makes some of the Gaussians unusable; the image must be that of the others.
HIDDEN = {
    "behind the camera": ("means", torch.tensor([0.1, 0.0, -2.0])),
    "on the camera": ("means", torch.tensor([0.0, 0.0, 0.0])),
    "before the near plane": ("means", torch.tensor([0.0, 0.0, 0.0099])),
    "a million metres aside": ("means", torch.tensor([1e6, 1e6, 1.0])),
    "beyond the far plane": ("means", torch.tensor([0.0, 0.0, 3e10])),
    "without a rotation": ("quats", torch.zeros(4)),
    "transparent": ("opacities", torch.tensor(-80.0).double().sigmoid()),
}
# What is hard but seen.
SEEN = {
    "needles": ("scales", torch.tensor([0.5, 5e-7, 5e-7])),
    "pancakes": ("scales", torch.tensor([0.4, 0.3, 4e-7])),
    "walls": ("scales", torch.tensor([1e3, 1e3, 1e-3])),
    "grains": ("scales", torch.tensor([1e-8, 1e-8, 1e-8])),
    "opaque": ("opacities", torch.tensor(80.0).double().sigmoid()),
    "at one depth": ("means", torch.tensor([0.1, 0.05, 2.0])),
}


def struck(scene: Scene, name: str, every: int) -> tuple[Scene, torch.Tensor]:
    """The scene with every n-th Gaussian changed, and which they are."""
    key, value = (HIDDEN | SEEN)[name]
    changed = torch.arange(COUNT) % every == 0
    tensor = getattr(scene, key).clone()
    if key == "opacities":
        tensor[:, changed] = value.double()
    else:
        tensor[changed] = value.double()
    return rounded(replace(scene, **{key: tensor})), changed


@pytest.mark.parametrize("name", HIDDEN)
def test_unusable_gaussians_leave_the_others_as_they_are(backend, name):
    scene, changed = struck(sound(1), name, 3)
    actual = run(backend, scene)
    assert_finite(actual)
    keys = ("means", "quats", "scales", "features")
    alone = replace(
        scene, opacities=scene.opacities[:, ~changed], **{key: getattr(scene, key)[~changed] for key in keys}
    )
    expected = run(backend, alone)
    assert relative(actual.output.features, expected.output.features) < 1e-6
    for key in keys:
        assert (actual.gradients[key][changed] == 0).all(), key
        assert relative(actual.gradients[key][~changed], expected.gradients[key]) < 1e-5, key


@pytest.mark.parametrize("name", SEEN)
@pytest.mark.parametrize("antialiased", [False, True])
def test_hard_gaussians_among_others(backend, name, antialiased):
    scene, _ = struck(sound(2), name, 4)
    actual, expected = run(backend, scene, antialiased=antialiased), oracle(scene, antialiased=antialiased)
    assert_finite(actual)
    assert relative(actual.output.features, expected.output.features) < 1e-3
    assert relative(actual.output.alpha, expected.output.alpha) < 1e-3
    for key in ("opacities", "features", "background"):
        assert relative(actual.gradients[key], expected.gradients[key]) < 1e-2, key


@settings(max_examples=12)
@given(st.integers(0, 2**31), st.lists(st.sampled_from([*HIDDEN, *SEEN]), min_size=2, max_size=5, unique=True))
def test_everything_at_once_is_finite_and_the_same_twice(seed, names):
    """All backends that run on a CPU: finite images and gradients, the same bits, and the float64 reference's image."""
    scene = sound(seed)
    for number, name in enumerate(names):
        scene, _ = struck(scene, name, 3 + number)
    expected = oracle(scene)
    for backend in ("reference", "cpu"):
        first, second = run(backend, scene), run(backend, scene)
        assert_finite(first)
        for key, image in (first.images() | first.gradients).items():
            assert torch.equal(image, (second.images() | second.gradients)[key]), (backend, key)
        assert relative(first.output.features, expected.output.features) < 2e-3, backend


def test_axis_ratios_up_to_a_million(backend):
    random = generator(3)
    scales = torch.stack([logarithmic(0.1, 1.0, random, COUNT), *logarithmic(1e-6, 1.0, random, 2, COUNT)], dim=1)
    scene = rounded(replace(sound(3), scales=scales))
    actual, expected = run(backend, scene), oracle(scene)
    assert_finite(actual)
    assert relative(actual.output.features, expected.output.features) < 5e-4
    for key in ("means", "opacities", "features"):
        assert relative(actual.gradients[key], expected.gradients[key]) < 1e-2, key


@pytest.mark.parametrize("size", [(1, 1), (4096, 1), (1, 4096), (4096, 3), (17, 1)], ids=str)
def test_images_of_extreme_shapes(backend, size):
    scene = sound(4)
    K = torch.tensor([[max(size), 0, size[0] / 2], [0, max(size), size[1] / 2], [0, 0, 1]], dtype=torch.float64)
    scene = rounded(replace(scene, width=size[0], height=size[1], K=K))
    actual, expected = run(backend, scene), oracle(scene)
    assert_finite(actual)
    assert actual.output.features.shape == (size[1], size[0], 1)
    assert relative(actual.output.features, expected.output.features) < 5e-4
    assert relative(actual.gradients["features"], expected.gradients["features"]) < 1e-3


def test_a_scene_at_a_million_metres_is_a_matter_of_its_origin(backend):
    """In float32 a millimetre is lost at 1e6 m: loaders recentre such scenes (heatsplat.datamodules.assemble), and then agree."""
    scene = sound(5)
    away = torch.tensor([4e5, 5e6, 300.0], dtype=torch.float64)
    viewmat = scene.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ away
    far = replace(scene, means=scene.means + away, viewmat=viewmat)
    assert_finite(run(backend, rounded(far)))
    recentred = far.viewmat.clone()
    recentred[:3, 3] += recentred[:3, :3] @ away
    near = rounded(replace(far, means=far.means - away, viewmat=recentred))
    assert relative(run(backend, near).output.features, oracle(far).output.features) < 1e-4
