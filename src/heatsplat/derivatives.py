"""Functions with a backward pass of their own have first derivatives only, and say so where second ones are asked for."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """The backward pass of an autograd Function; to differentiate what it gives raises RuntimeError.

    torch's decorator of this name raises only where the incoming gradient itself depends on parameters. A loss that is linear
    in an image has a constant one, and what depends on its gradient would then train without that part.
    """

    @functools.wraps(backward)
    def guarded(ctx: Any, *grads: Tensor | None) -> Any:
        if not torch.is_grad_enabled():  # without create_graph, as in training
            return backward(ctx, *grads)
        with torch.no_grad():
            found = backward(ctx, *grads)
        results = found if isinstance(found, tuple) else (found,)
        name = type(ctx).__name__.removesuffix("Backward").lstrip("_")
        told = (
            f"{name} has no second derivatives (create_graph=True): leave its gradient out of the loss, or take the renderer "
            "'reference'"
        )
        refuse = torch._C._functions.DelayedError(told.encode(), len(results))
        return refuse(*(None if value is None else value.detach().requires_grad_() for value in results))

    return guarded
