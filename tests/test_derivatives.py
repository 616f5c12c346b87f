"""A backward pass of ours that cannot be differentiated says so, whatever loss follows it."""

import ast
from pathlib import Path

import pytest
import torch

from heatsplat.derivatives import once_differentiable
from heatsplat.renderers import rasterization
from heatsplat.same_bits import PIECE, sigmoid
from heatsplat.sensors.point_spread import _Blur

ROOT = Path(__file__).resolve().parents[1]
# Their backward passes are torch functions of the incoming gradient alone, which torch differentiates.
LINEAR = {"_Everywhere", "_StraightThroughClamp"}


class Halves(torch.autograd.Function):
    """Two outputs, and an input without a gradient."""

    @staticmethod
    def forward(ctx, values, count):
        ctx.save_for_backward(values)
        return values.square() / count, values.square()

    @staticmethod
    @once_differentiable
    def backward(ctx, first, second):
        (values,) = ctx.saved_tensors
        return values * first + 2 * values * second, None


def rendered(backend):
    """Two Gaussians' image, and their centres."""
    means = torch.tensor([[0.0, 0.1, 0.0], [0.2, 0.0, 0.5]], requires_grad=True)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.2)
    viewmat, K = torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    viewmat[2, 3] = 2.0
    given = (means, quats, scales, torch.full((1, 2), 0.5), torch.ones(2, 1), viewmat, K)
    given = [tensor.double() for tensor in given] if backend == "reference" else given
    return rasterization(*given, 16, 16, backend=backend).features, means


def blurred():
    variance = torch.tensor(0.5, requires_grad=True)
    return _Blur.apply(torch.rand(6, 6, 1, generator=torch.Generator().manual_seed(0)), variance, 3), variance


def squashed():
    values = torch.linspace(-2, 2, PIECE + 8, requires_grad=True)
    return sigmoid(values), values


def halved():
    values = torch.tensor([1.0, 2.0], requires_grad=True)
    return Halves.apply(values, 2)[0], values


@pytest.mark.parametrize("loss", [torch.sum, lambda image: image.square().sum()])
@pytest.mark.parametrize("made", [lambda: rendered("cpu"), blurred, squashed, halved])
def test_second_derivatives_are_refused_by_name(made, loss):
    image, values = made()
    (slope,) = torch.autograd.grad(loss(image), values, create_graph=True)
    with pytest.raises(RuntimeError, match=r"has no second derivatives \(create_graph=True\): leave its gradient out"):
        (slope.square().sum() + values.sum()).backward()


def test_the_reference_has_second_derivatives():
    image, means = rendered("reference")
    (slope,) = torch.autograd.grad(image.sum(), means, create_graph=True)
    (curved,) = torch.autograd.grad(slope.square().sum(), means)
    assert curved.abs().min() > 0


def test_first_derivatives_are_those_of_the_function():
    image, values = halved()
    plain, kept = (
        torch.autograd.grad(image.sum(), values, create_graph=kept, retain_graph=True)[0] for kept in (False, True)
    )
    assert plain.tolist() == kept.tolist() == [1.0, 2.0] and not plain.requires_grad


def test_every_backward_pass_of_ours_is_marked_or_is_linear():
    unmarked = set()
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "datamodules").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        assert "torch.autograd.function" not in text, path  # whose mark is weaker
        for kind in ast.walk(ast.parse(text)):
            if isinstance(kind, ast.ClassDef) and any("autograd.Function" in ast.unparse(base) for base in kind.bases):
                marks = {
                    part.name: " ".join(map(ast.unparse, part.decorator_list))
                    for part in kind.body
                    if isinstance(part, ast.FunctionDef)
                }
                if "once_differentiable" not in marks.get("backward", "once_differentiable"):
                    unmarked.add(kind.name)
    assert unmarked == LINEAR
