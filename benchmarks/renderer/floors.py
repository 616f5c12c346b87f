"""How quick a kernel could be at most: vector instructions at the measured rate, or bytes at the measured rate.

The slower of the two is the floor of a part. Instructions are those of the inner loops, counted by hand from
heatsplat.kernels with a multiply-add as one; they leave out addresses, branches and latency. Bytes are what a part
must read and write once, were there no cache; so a floor of bytes may be passed while that of instructions may not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from heatsplat.kernels.simd import LANES

# Vector instructions per block of sixteen pixels: geometry and density, then for each modality, for each channel.
FORWARD = 16, 10, 3
BACKWARD = 29, 12, 5
# Per sixteen Gaussians.
PROJECTION, PROJECTION_BACKWARD, ADAM = 250, 350, 15
SPANS = 60  # per visible Gaussian: the blocks it reaches in sixteen rows of blocks
SSIM = 7 * 22 + 70  # per sixteen numbers of the image: four blurs forward, three backward, and what they are made into
RESPONSES, RESPONSES_BACKWARD = 14, 40  # per sixteen frequencies of a Gaussian

GEOMETRY = 11  # numbers: mean, quaternion, scales, opacity
SORT_PASSES = 3
SCREEN, INSTANCE, FOUND, SLOT_HEADER = 64, 16, 16, 32  # bytes of a row


@dataclass(frozen=True)
class Machine:
    """Rates of a number of threads: multiply-adds on sixteen lanes, and bytes from and to memory, per second."""

    vectors: float
    bytes: float

    def milliseconds(self, vectors: float = 0.0, numbers: float = 0.0, bytes: float = 0.0) -> float:
        """The time that neither the instructions nor the traffic can do without; ``numbers`` are float32."""
        return 1e3 * max(vectors / self.vectors, (bytes + 4 * numbers) / self.bytes)


@dataclass(frozen=True)
class Work:
    """What a rendering had to do: Gaussians, those visible, instances, evaluated blocks, and the sizes of its rows."""

    gaussians: int
    visible: int
    instances: int
    blocks: int
    pixels: int
    channels: int
    modalities: int

    @classmethod
    def of(cls, image: Tensor) -> Work:
        """What the CPU renderer did for an image [H, W, C] that autograd still remembers."""
        node = image.grad_fn
        while node is not None and not hasattr(node, "frame"):
            node = node.next_functions[0][0] if node.next_functions else None
        frame = node.frame
        count = int(frame.tile_starts[-1])
        steps = np.zeros(count + 1, np.int64)  # +1 where a tile begins, -1 behind the last instance it looked at
        np.add.at(steps, frame.tile_starts[:-1], 1)
        np.add.at(steps, frame.tile_ends, -1)
        masks = frame.instances[:count, 1][steps[:-1].cumsum() > 0]
        blocks = int(np.unpackbits(masks.view(np.uint8)).sum())
        layout, inputs = frame.layout, frame.inputs
        pixels = inputs.width * inputs.height
        return cls(frame.count, len(frame.ids), count, blocks, pixels, layout.channels, layout.modalities)

    def floors(self, machine: Machine) -> dict[str, float]:
        """Floor of each part of a rendering and its gradients, in milliseconds."""
        forward, backward = (base + m * self.modalities + c * self.channels for base, m, c in (FORWARD, BACKWARD))
        record, state = 8 + self.channels, self.channels + self.modalities
        groups = self.gaussians / LANES
        return {
            "projection": machine.milliseconds(
                PROJECTION * groups, self.gaussians * (GEOMETRY + 4), self.visible * (SCREEN + 12)
            ),
            "binning": machine.milliseconds(
                SPANS * self.visible,
                self.visible * (2 * record + 4 * SORT_PASSES),
                self.visible * SCREEN + self.instances * (2 * FOUND + INSTANCE),
            ),
            "forward": machine.milliseconds(
                forward * self.blocks, 2 * self.pixels * state, self.instances * (INSTANCE + 4 * record)
            ),
            "backward": machine.milliseconds(
                backward * self.blocks, 3 * self.pixels * state, self.instances * (INSTANCE + 8 * record)
            ),
            "gradients": machine.milliseconds(
                PROJECTION_BACKWARD * groups,
                self.gaussians * (2 * GEOMETRY + 2) + self.instances * record,
                self.visible * 2 * SLOT_HEADER,
            ),
        }


def step_floors(work: Work, machine: Machine, frequencies: int, parameters: int, together: int = 1) -> dict[str, Any]:
    """Floor of each part of a training step in milliseconds; torch and Lightning have none.

    Args:
        frequencies: of a Gaussian's heat source; 0 where there is none.
        parameters: numbers that the optimiser moves.
        together: steps that it moves them after.
    """
    vectors = -(-frequencies // LANES)
    return work.floors(machine) | {
        "loss": machine.milliseconds(SSIM * work.pixels * work.channels / LANES, 12 * work.pixels * work.channels),
        "thermal": machine.milliseconds(
            (RESPONSES + RESPONSES_BACKWARD) * vectors * work.visible, 3 * 2 * frequencies * work.visible
        ),
        "optimiser": machine.milliseconds(ADAM * parameters / LANES, 7 * parameters) / together,
    }
