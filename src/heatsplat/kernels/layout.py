"""The channel layout of an image as a compile-time constant: Numba compiles the compositing kernels once per layout."""

from __future__ import annotations

from dataclasses import dataclass

from llvmlite import ir
from numba.core import types
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_i64 = ir.IntType(64)


@dataclass(frozen=True)
class Layout:
    """Which modality composites which channel.

    Args:
        modality_of: one entry per channel, the modality whose opacity composites it.
        modalities: how many modalities there are; one without channels still has an alpha.
        depth: whether the last channel is depth, which is composited without a background.
        absgrad: whether the backward pass also gathers absolute screen gradients.
    """

    modality_of: tuple[int, ...]
    modalities: int = 1
    depth: bool = False
    absgrad: bool = False

    @property
    def channels(self) -> int:
        return len(self.modality_of)

    @property
    def record(self) -> int:
        """Numbers per projected Gaussian: geometry, opacity of each modality where there are several, features."""
        ratios = self.modalities if self.modalities > 1 else 0
        return -(-(GEOMETRY + ratios + self.channels) // 8) * 8

    @property
    def moments(self) -> int:
        """Numbers per gradient slot (heatsplat.kernels.projection has their order)."""
        return 6 + self.modalities + self.channels - self.depth + 2 * self.absgrad

    @property
    def slot(self) -> int:
        """Distance of gradient slots: the moments, in whole quarters of a vector."""
        return -(-self.moments // 4) * 4


GEOMETRY = 6  # mean x, mean y, three numbers of the whitening, log2 of the largest opacity


class LayoutType(types.Type):
    """Numba type of one Layout; its values carry nothing."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        super().__init__(f"Layout({layout.modality_of}, {layout.modalities}, {layout.depth}, {layout.absgrad})")


@typeof_impl.register(Layout)
def _typeof_layout(value, _):
    return LayoutType(value)


@register_model(LayoutType)
class _LayoutModel(models.OpaqueModel):
    pass


@unbox(LayoutType)
def _unbox_layout(numba_type, value, c):
    return NativeValue(c.context.get_dummy_value())


def _constant(read):
    """An intrinsic that gives a property of a layout as a literal."""

    @intrinsic
    def function(typing_context, layout):
        if not isinstance(layout, LayoutType):
            return None
        number = int(read(layout.layout))

        def generate(context, builder, signature, values):
            return ir.Constant(_i64, number)

        return types.literal(number)(layout), generate

    return function


channels = _constant(lambda layout: layout.channels)
modalities = _constant(lambda layout: layout.modalities)
moment_count = _constant(lambda layout: layout.moments)
has_depth = _constant(lambda layout: layout.depth)
has_absgrad = _constant(lambda layout: layout.absgrad)


@intrinsic
def modality_of(typing_context, layout, channel):
    """The modality that composites a channel; a constant once the loop over channels is unrolled."""
    if not isinstance(layout, LayoutType):
        return None

    def generate(context, builder, signature, values):
        result = ir.Constant(_i64, 0)
        channel = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        for position, modality in enumerate(layout.layout.modality_of):
            if modality:
                same = builder.icmp_signed("==", channel, ir.Constant(_i64, position))
                result = builder.select(same, ir.Constant(_i64, modality), result)
        return result

    return types.int64(layout, channel), generate
