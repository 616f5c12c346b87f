"""The same bits on any number of threads, and from Python threads at once."""

from concurrent.futures import ThreadPoolExecutor

import numba
import pytest
import torch
from torch import Tensor

from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.renderers import rasterization
from heatsplat.training.rng import generator_for

needs_two = pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine runs one thread only")


@pytest.fixture(autouse=True)
def keep_threads():
    kernels, torchs = thread_count(), torch.get_num_threads()
    yield
    use_threads(kernels)
    torch.set_num_threads(torchs)


def everything(threads: int, channels: tuple[int, ...], **options: bool) -> list[Tensor]:
    """Images and all gradients of a scene with opaque, faint, small and large Gaussians."""
    use_threads(threads)
    generator = generator_for(0, 0, "threads")
    count = 3000
    leaves = {
        "means": torch.rand(count, 3, generator=generator) * 4 - torch.tensor([2.0, 2.0, -1.0]),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.exp(torch.randn(count, 3, generator=generator) - 3.5),
        "opacities": torch.rand(len(channels), count, generator=generator),
        "features": torch.rand(count, sum(channels), generator=generator),
        "viewmats": torch.eye(4),
    }
    leaves = {name: value.requires_grad_() for name, value in leaves.items()}
    K = torch.tensor([[120.0, 0, 75], [0, 120, 60], [0, 0, 1]])
    output = rasterization(
        **leaves, Ks=K, width=150, height=117, backend="cpu", modality_channels=channels, **options
    )  # fmt: skip
    images = [output.features, output.alpha] + ([output.depth] if output.depth is not None else [])
    sum((image * torch.linspace(-1, 1, image.numel()).view(image.shape)).sum() for image in images).backward()
    means2d = output.meta["means2d"]
    extra = [means2d.absgrad] if options.get("absgrad") else []
    return [*images, *(leaf.grad for leaf in leaves.values()), means2d.grad, *extra]


@needs_two
@pytest.mark.parametrize(
    ("channels", "options"),
    [((1,), {"depth": False}), ((3, 1), {"absgrad": True, "antialiased": True})],
    ids=["one channel", "rgb and thermal"],
)
def test_one_thread_and_two_give_the_same_bits(channels, options):
    one, two, again = (everything(threads, channels, **options) for threads in (1, 2, 2))
    for a, b, c in zip(one, two, again, strict=True):
        assert torch.equal(a, b) and torch.equal(b, c)
        assert a.abs().sum() > 0


@needs_two
def test_python_threads_may_render_at_once():
    expected = everything(2, (1,), depth=False)
    with ThreadPoolExecutor(3) as pool:
        for result in pool.map(lambda _: everything(2, (1,), depth=False), range(6)):
            for a, b in zip(result, expected, strict=True):
                assert torch.equal(a, b)


def test_threads_beyond_the_processor_are_not_asked_for():
    use_threads(10_000)
    assert thread_count() == numba.config.NUMBA_NUM_THREADS
