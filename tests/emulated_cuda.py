"""A CUDA device that is not there: its tensors lie in the processor's memory, say that they do not, and refuse to mix.

What fails on CUDA because a tensor was left on the CPU fails here, where no GPU is: operations over both devices, indices on
another device than what they index, generators of the CPU, ``numpy()``. Values are those of the CPU. To torch's core the device
is "meta", for which a CPU build has all that autograd asks for; what Python sees of it says "cuda:0". Tensors that torch's core
makes on its own, such as the 0 of a ``where``, are caught by a mode of their own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from unittest.mock import patch

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

DEVICE = torch.device("cuda", 0)
CPU = torch.device("cpu")
aten = torch.ops.aten
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default}
CUDA = {  # what torch.cuda says of it
    "is_available": True, "device_count": 1, "current_device": 0, "is_initialized": False, "get_device_name": "emulated",
    "get_device_capability": (9, 0), "synchronize": None, "set_device": None, "empty_cache": None,
    "reset_peak_memory_stats": None, "max_memory_allocated": 0, "memory_allocated": 0,
}  # fmt: skip


class OnDevice(torch.Tensor):
    """A tensor of the device; ``inner`` is what it holds."""

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> OnDevice:
        return torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            layout=inner.layout, device="meta", requires_grad=inner.requires_grad,
        )  # fmt: skip

    def __init__(self, inner: torch.Tensor) -> None:
        self.inner = inner

    def __repr__(self) -> str:
        return f"OnDevice({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func is aten.copy_.default and not isinstance(args[0], OnDevice):
            return args[0].copy_(args[1].inner)
        _refuse_mixing(func, args, kwargs)
        leaves = kwargs.get("device", DEVICE) == CPU
        if "device" in kwargs:
            kwargs["device"] = CPU
        plain_args, plain_kwargs = tree_map_only(OnDevice, lambda x: x.inner, (args, kwargs))
        found = func(*plain_args, **plain_kwargs)
        if leaves:
            return found.clone() if found is args[0].inner else found
        found = tree_map_only(torch.Tensor, lambda x: x if isinstance(x, OnDevice) else OnDevice(x), found)
        return return_and_correct_aliasing(func, args, kwargs, found)


def _refuse_mixing(func, args, kwargs) -> None:
    """As torch does for tensors of a CPU and of CUDA; numbers, tensors without dimensions, may come from the CPU."""
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    strangers = [x for x in tensors if not isinstance(x, OnDevice) and x.dim() > 0]
    if func in INDEXING:
        if not isinstance(args[0], OnDevice):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
    elif strangers and func is not aten.copy_.default:
        raise RuntimeError(f"Expected all tensors to be on the same device, but {func} got cuda:0 and cpu")
    _refuse_generator(kwargs)


def _refuse_generator(kwargs) -> None:
    if kwargs.get("generator") is not None:
        raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")


class _Sent(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor: torch.Tensor) -> OnDevice:
        return OnDevice(tensor.detach().clone())

    @staticmethod
    def backward(ctx, v: torch.Tensor) -> torch.Tensor:
        return v.inner.clone() if isinstance(v, OnDevice) else v


def _sent(tensor: torch.Tensor) -> OnDevice:
    if isinstance(tensor, OnDevice):
        return tensor
    return _Sent.apply(tensor) if tensor.requires_grad else OnDevice(tensor.detach().clone())


def _is_cuda(device: object) -> bool:
    return isinstance(device, str | torch.device) and str(device).startswith("cuda")


def _moved(tensor, *rest, **named):
    """``Tensor.to`` that names the device, or a tensor that lies there."""
    named_dtype = [x for x in (*rest, *named.values()) if isinstance(x, torch.dtype)]
    others = [x for x in (*rest, *named.values()) if isinstance(x, OnDevice)]
    dtype = next(iter([*named_dtype, *(x.dtype for x in others)]), None)
    return _sent(tensor) if dtype is None else _sent(tensor).to(dtype)


def _index(index):
    """An index whose tensors lie on the device, as torch's core would send them."""

    def sent(x):
        x = torch.tensor(x) if isinstance(x, list) else torch.as_tensor(x) if hasattr(x, "__array__") else x
        return OnDevice(x) if isinstance(x, torch.Tensor) and not isinstance(x, OnDevice) else x

    return tuple(map(sent, index)) if isinstance(index, tuple) else sent(index)


class _Faces(TorchFunctionMode):
    """What Python sees: devices, moves between them, and tensors that are made on them."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        first = args[0] if args else None
        if isinstance(first, OnDevice):
            if func == torch.Tensor.device.__get__:
                return DEVICE
            if func == torch.Tensor.is_cuda.__get__:
                return True
            if func in (torch.Tensor.is_meta.__get__, torch.Tensor.is_cpu.__get__):
                return False
            if func is torch.Tensor.numpy:
                raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")
            if func is torch.Tensor.tolist:
                return first.inner.tolist()
            if func is torch.Tensor.__format__:
                return format(first.inner.detach(), *args[1:])
            if func is torch.Tensor.new_tensor:
                return OnDevice(torch.tensor(args[1], **{"dtype": first.dtype, **kwargs}))
            if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
                values = [
                    x if isinstance(x, torch.Tensor) else OnDevice(torch.tensor(x, dtype=first.dtype)) for x in args[2:]
                ]
                return func(first, _index(args[1]), *values)
        if func is torch.Tensor.cuda:
            return _sent(first)
        if func is torch.Tensor.to:
            given = (*args[1:], *kwargs.values())
            if any(_is_cuda(x) or isinstance(x, OnDevice) for x in given):
                return _moved(*args, **kwargs)
        if func in (torch.where, torch.Tensor.where) and any(isinstance(x, OnDevice) for x in args):
            args = tuple(OnDevice(torch.tensor(x)) if isinstance(x, int | float) else x for x in args)
        if _is_cuda(kwargs.get("device")):
            plain = {name: value for name, value in kwargs.items() if name != "device"}
            if isinstance(first, OnDevice):
                return func(*args, **plain)
            _refuse_generator(kwargs)
            found = func(*args, **plain)
            return OnDevice(found.detach()).requires_grad_(found.requires_grad)
        return func(*args, **kwargs)


class _Makers(TorchDispatchMode):
    """Tensors that torch's core makes on the device out of nothing."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        device = kwargs.get("device")
        nothing = not any(isinstance(x, OnDevice) for x in tree_leaves(args))
        if device is not None and device.type == "meta" and nothing:
            return OnDevice(func(*args, **(kwargs | {"device": CPU})))
        return func(*args, **kwargs)


@contextlib.contextmanager
def emulated_cuda() -> Iterator[torch.device]:
    """The device, which torch sees as long as this lasts."""
    with contextlib.ExitStack() as stack:
        for name, answer in CUDA.items():
            stack.enter_context(patch.object(torch.cuda, name, lambda *_, answer=answer: answer))
        stack.enter_context(_Makers())
        stack.enter_context(_Faces())
        yield DEVICE
