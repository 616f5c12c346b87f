"""The channels of an image as a compile-time constant: compositing is compiled once per layout."""

from __future__ import annotations

from dataclasses import dataclass

from llvmlite import ir
from numba.core import types
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

from heatsplat.kernels.constants import ELLIPSE, OPACITY_GRADIENTS

_i64 = ir.IntType(64)


@dataclass(frozen=True)
class Layout:
    """Which modality composites which channel.

    Args:
        modality_of: one entry per channel, the modality whose opacity composites it.
        modalities: how many modalities there are; one without channels still has an alpha.
        depth: whether the last channel is depth, which has no background.
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
    def feature_column(self) -> int:
        """Where the channels begin in a record: after the ellipse, and the opacities where there are several."""
        return ELLIPSE + (self.modalities if self.modalities > 1 else 0)

    @property
    def record_size(self) -> int:
        """Numbers per record, in whole half cache lines."""
        return -(-(self.feature_column + self.channels) // 8) * 8

    @property
    def slot_columns(self) -> int:
        """Numbers per gradient slot (heatsplat.kernels.constants has their order)."""
        return OPACITY_GRADIENTS + self.modalities + self.channels - self.depth + 2 * self.absgrad

    @property
    def slot_size(self) -> int:
        """Distance of gradient slots, at least the columns of ``sums``."""
        return max(8, -(-self.slot_columns // 4) * 4)


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


def _constant(name: str):
    """An intrinsic that gives a property of a layout as a literal."""

    @intrinsic
    def function(typing_context, layout):
        if not isinstance(layout, LayoutType):
            return None
        number = int(getattr(layout.layout, name))
        return types.literal(number)(layout), lambda context, builder, signature, values: ir.Constant(_i64, number)

    return function


channels = _constant("channels")
modalities = _constant("modalities")
feature_column = _constant("feature_column")
slot_columns = _constant("slot_columns")
has_depth = _constant("depth")
has_absgrad = _constant("absgrad")


@intrinsic
def modality_of(typing_context, layout, channel):
    """The modality that composites a channel; a constant once the loop over channels is unrolled."""
    if not isinstance(layout, LayoutType):
        return None

    def generate(context, builder, signature, values):
        channel = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        result = ir.Constant(_i64, 0)
        for position, modality in enumerate(layout.layout.modality_of):
            if modality:
                same = builder.icmp_signed("==", channel, ir.Constant(_i64, position))
                result = builder.select(same, ir.Constant(_i64, modality), result)
        return result

    return types.int64(layout, channel), generate
