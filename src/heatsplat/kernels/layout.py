"""The channels of an image as a compile-time constant: compositing is compiled once per layout.

Only what shapes the innermost loops is part of it. Depth is one more channel; whether the last one is depth is known at
run time.
"""

from __future__ import annotations

from dataclasses import dataclass

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from heatsplat.kernels.compile_time import ConstantType, compile_time, constant
from heatsplat.kernels.constants import ELLIPSE, OPACITY_GRADIENTS

_i64 = ir.IntType(64)


@compile_time
@dataclass(frozen=True)
class Layout:
    """Which modality composites which channel.

    Args:
        modality_of: one entry per channel, depth included, the modality whose opacity composites it.
        modalities: how many modalities there are; one without channels still has an alpha.
        absgrad: whether the backward pass also gathers absolute screen gradients; false in the forward pass.
        maps: how many maps over pixels the backward pass sums by the weights of the first modality; 0 in the forward pass.
    """

    modality_of: tuple[int, ...]
    modalities: int = 1
    absgrad: bool = False
    maps: int = 0

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
    def pixel_rows(self) -> int:
        """Numbers that the backward pass has of a pixel: gradients of its channels and alphas, and maps."""
        return self.channels + self.modalities + self.maps

    @property
    def slot_columns(self) -> int:
        """Numbers per gradient slot (heatsplat.kernels.constants has their order)."""
        return OPACITY_GRADIENTS + self.modalities + self.channels + self.maps + 2 * self.absgrad

    @property
    def slot_size(self) -> int:
        """Distance of gradient slots, at least the columns of ``sums``."""
        return max(8, -(-self.slot_columns // 4) * 4)


channels = constant("channels")
modalities = constant("modalities")
feature_column = constant("feature_column")
map_count = constant("maps")
pixel_rows = constant("pixel_rows")
slot_columns = constant("slot_columns")
has_absgrad = constant("absgrad")


@intrinsic
def modality_of(typing_context, layout, channel):
    """The modality that composites a channel; a constant once the loop over channels is unrolled."""
    if not isinstance(layout, ConstantType):
        return None

    def generate(context, builder, signature, values):
        channel = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        result = ir.Constant(_i64, 0)
        for position, modality in enumerate(layout.value.modality_of):
            if modality:
                same = builder.icmp_signed("==", channel, ir.Constant(_i64, position))
                result = builder.select(same, ir.Constant(_i64, modality), result)
        return result

    return types.int64(layout, channel), generate
