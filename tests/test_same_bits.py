"""Sums and functions of many numbers: right, and the same bits for any number of threads."""

import pytest
import torch
from threads import with_threads

from heatsplat.same_bits import PIECE, ROW, everywhere, mean, sigmoid, softplus, total, weighted
from heatsplat.splats import Splats

NUMBERS = 3 * PIECE + 12_345  # more than torch leaves to one thread; shares of threads end inside vectors


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", [0, 1, ROW - 1, ROW, 20 * ROW + 7])
def test_a_total_is_the_sum(count):
    values = random(count).double()
    assert total(values).item() == pytest.approx(values.sum().item(), rel=1e-14)
    assert total(values.reshape(1, -1, 1)).shape == ()


def test_a_total_has_the_same_bits_for_any_number_of_threads():
    values = random(301, 403, 3)
    assert len({total(values.transpose(0, 1)).item() for _ in range(3)}) == 1
    assert len(set(with_threads((1, 2, 3, 7), lambda: total(values).item()))) == 1


def test_a_mean_is_torchs_with_the_gradient_of_torchs():
    values = random(NUMBERS).double().requires_grad_()
    found, expected = mean(values), values.mean()
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=0)
    torch.testing.assert_close(
        *(torch.autograd.grad(one, values)[0] for one in (found, expected)), rtol=1e-12, atol=1e-20
    )


@pytest.mark.parametrize("shape", [(), (1,)])
def test_a_number_everywhere_has_the_gradient_of_one_that_is_broadcast(shape):
    image = random(301, 403, 1).double()
    gradients = []
    for spread in (everywhere, lambda value, image: value):
        value = torch.full(shape, 0.3, dtype=torch.float64, requires_grad=True)
        (image * spread(value, image)).sin().sum().backward()
        gradients.append(value.grad)
    torch.testing.assert_close(*gradients, rtol=1e-13, atol=0)
    assert everywhere(torch.full(shape, 2.0), image).shape == image.shape


@pytest.mark.parametrize("shape", [(PIECE,), (NUMBERS, 1), (20_001, 3)])
def test_a_sigmoid_is_torchs_on_one_thread_and_the_same_on_others(shape):
    values = (12.0 * random(*shape) - 6.0).requires_grad_()
    pull = random(*shape, seed=1)

    def results(function):
        found = function(values)
        return found.detach(), torch.autograd.grad(found, values, pull)[0]

    (expected,) = with_threads((1,), lambda: results(torch.sigmoid))
    for found in with_threads((1, 2, 3, 7), lambda: results(sigmoid)):
        assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    apart = values.detach().double()[::2]
    torch.testing.assert_close(sigmoid(apart), apart.sigmoid(), rtol=1e-15, atol=0)


def test_opacities_have_the_same_bits_for_any_number_of_threads():
    shapes = {"means": torch.zeros(70_001, 3), "log_scales": torch.zeros(70_001, 3), "quats": torch.ones(70_001, 4)}
    splats = Splats(shapes | {"opacity_logits": 8 * random(70_001, 1) - 4})
    one, *others = with_threads((1, 2, 3, 5, 7), lambda: splats.opacities.detach().clone())
    assert one.shape == (1, 70_001) and all(torch.equal(one, other) for other in others)


@pytest.mark.parametrize("shape", [(PIECE,), (NUMBERS, 1), (20_001, 3)])
def test_a_softplus_is_exact_and_the_same_for_any_number_of_threads(shape):
    values, pull = (60.0 * random(*shape) - 30.0), random(*shape, seed=1)
    values.view(-1)[:3] = torch.tensor([0.0, 200.0, -200.0])
    values.requires_grad_()

    def results():
        found = softplus(values)
        return found.detach(), torch.autograd.grad(found, values, pull)[0]

    one, *others = with_threads((1, 2, 3, 7), results)
    exact = values.detach().double()
    torch.testing.assert_close(one[0].double(), torch.logaddexp(exact, torch.zeros_like(exact)), rtol=3e-7, atol=1e-40)
    torch.testing.assert_close(one[1].double(), exact.sigmoid() * pull, rtol=1e-6, atol=1e-40)
    for other in others:
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_weighted_columns_and_their_gradients_are_right_and_the_same_for_any_number_of_threads():
    columns, pull = random(NUMBERS, 9).requires_grad_(), random(NUMBERS, seed=1) - 0.5
    weights = (random(9, seed=2) - 0.5).requires_grad_()

    def results():
        found = weighted(columns, weights)
        return [found.detach(), *torch.autograd.grad((found * pull).sum(), (columns, weights))]

    one, *others = with_threads((1, 2, 3, 7), results)
    exact = columns.detach().double(), weights.detach().double(), pull.double()
    torch.testing.assert_close(one[0].double(), exact[0] @ exact[1], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(one[2].double(), exact[0].T @ exact[2], rtol=1e-4, atol=1e-2)
    for other in others:
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


@pytest.mark.parametrize("width", [1, 2, 16, 64])
def test_weights_of_a_layer_learn_the_same_bits_for_any_number_of_threads(width):
    values, layer = random(NUMBERS, 16) - 0.5, torch.nn.Linear(16, width)
    pull = random(NUMBERS, width, seed=1) - 0.5
    one, *others = with_threads(
        (1, 2, 3, 7), lambda: torch.autograd.grad((layer(values) * pull).sum(), layer.weight)[0]
    )
    assert one.any()
    assert all(torch.equal(one, other) for other in others)
