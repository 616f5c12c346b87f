"""Numbers that the renderer's kernels share: of the image, of the tiles, of the rows they hand to each other."""

from __future__ import annotations

import math

import numpy as np

# Of the image, equal to those of heatsplat.renderers.base (a test compares them), as float32 so that arithmetic stays
# so.
ALPHA_MIN = np.float32(1.0 / 255.0)
ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)
LOG2_ALPHA_MIN = np.float32(-math.log2(255.0))

# A block of 4x4 pixels is one vector, an image is cut into tiles of 8x8 blocks, a tile's blocks fit the bits of an
# int64. Measured on 100 k Gaussians at 512x410: tiles of 4x4 blocks hold 1.8 times as many instances and take 1.15
# times as long.
BLOCK = 4
TILE_BLOCKS = 8
TILE = BLOCK * TILE_BLOCKS
BLOCKS = TILE_BLOCKS * TILE_BLOCKS

CHUNK = 1024  # Gaussians per parallel task of the projection: small enough to share out, large enough not to notice

# Whitened offsets are scaled by the square root of log2(e) / 2, so that a density is exp2(-u1^2 - u2^2).
WHITENING = np.float32(math.sqrt(math.log2(math.e) / 2.0))
INVERSE_WHITENING = np.float32(1.0 / WHITENING)
TWO_LN_2 = np.float32(2.0 * math.log(2.0))  # INVERSE_WHITENING squared

# Columns of ``screen``, what the projection finds out about a visible Gaussian; a row is one cache line.
# The ellipse (see projection) comes first, since it is what compositing needs.
MEAN_X, MEAN_Y, FIRST, MIXED, SECOND, LOG_OPACITY = range(6)
ELLIPSE = 6
DEPTH = 6  # camera z
LEFT, RIGHT, TOP, BOTTOM = range(7, 11)  # blocks of the bounding box; right and bottom are exclusive
LIMIT, PEAK, SLOPE, INVERSE_FIRST = range(11, 15)  # see binning
RANK = 15  # place among the visible Gaussians of its chunk
SCREEN = 16

# Columns of a gradient slot: five moments of the gradient (see compositing), the gradients of the logarithms of the
# opacities, of the channels, sums of maps, and two absolute ones where they are wanted.
OPACITY_GRADIENTS = 5
# Columns of ``sums``, what the projection's backward pass needs of the summed slots: the moments, and
DEPTH_GRADIENT = 5
LOG_OPACITY_GRADIENT = 6  # of all opacities together
SUMS = 8
