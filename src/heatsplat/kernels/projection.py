"""From Gaussians in the world to ellipses on the screen, sixteen at a time, and the gradients back.

Plain twin: heatsplat.geometry.projection, under autograd.

**Convention:** R is the rotation of a Gaussian, s its semi-axes, W the rotation of the camera and J the 2x3 Jacobian
of the projection, whose x/z and y/z are clamped to the field of view and a margin. The rows of J W R diag(s) are U
and V, so that the screen covariance with its blur eps2d is

    [[a, b], [b, c]] = [[U.U, U.V], [U.V, V.V]] + eps2d I,
    det = |U x V|^2 + eps2d (U.U + V.V) + eps2d^2        (Cauchy-Binet: a sum of squares, which never cancels).

Offsets (dx, dy) from the mean are whitened by the Cholesky factor of the inverse covariance instead of multiplied by
the inverse itself,

    u1 = first dx + mixed dy,  u2 = second dy,  density = exp(-(u1^2 + u2^2) / 2),
    first = sqrt(c / det),  mixed = -b / sqrt(c det),  second = 1 / sqrt(c),

so that rounding cannot make the exponent positive. The gradients back are products with the same factors, never with an
inverse, and with whitened axes in a form that does not cancel (``_covariance_backward``): those of needles of axis ratio
5e4 have relative errors of 1e-5 (measured; 3e-2 with the inverse), however far they reach beyond the image.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.constants import (
    ALPHA_MIN,
    BLOCK,
    BOTTOM,
    CHUNK,
    DEPTH,
    INVERSE_WHITENING,
    LEFT,
    LOG2_ALPHA_MIN,
    RANK,
    RIGHT,
    SUMS,
    TILE_BLOCKS,
    TOP,
    TWO_LN_2,
    WHITENING,
)
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import (
    LANES,
    absolute,
    bits,
    ceil,
    exp,
    first_lanes,
    floor,
    load_columns,
    log2,
    lowest_bit,
    mask_of,
    maximum,
    minimum,
    select,
    splat,
    sqrt,
    store_columns,
    store_vector,
    to_int,
    total,
)
from heatsplat.kernels.slots import clear_invisible, fetch_slots, sum_slots

# A camera is one float32 vector: rotation row by row in 0-8, translation in 9-11, then
FX, FY, CX, CY = range(12, 16)
LOWEST_X, HIGHEST_X, LOWEST_Y, HIGHEST_Y = range(16, 20)  # limits of x/z and y/z in the Jacobian
NEAR, FAR = 20, 21
EPS2D, EPS2D_SQUARED = 22, 23  # pixels² added to the screen covariance, and their square
CAMERA = 24

LARGEST_LOG = np.float32(88.0)  # of a float32
LARGEST = np.finfo(np.float32).max  # of a determinant: a round Gaussian of 4e9 pixels has one beyond, and is not seen


@inline
def _to_camera(camera, x, y, z):
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@inline
def _unit_quaternion(w, x, y, z):
    """Quaternions of length one, and their lengths; scaled by the largest part first: squares do not underflow."""
    largest = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    scale = 1.0 / largest
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    length = sqrt(w * w + x * x + y * y + z * z)
    scale = 1.0 / length
    return (w * scale, x * scale, y * scale, z * scale), largest * length


@inline
def _rotation(q):
    """Rotation matrices of unit quaternions, row by row."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@inline
def _rotation_backward(q, length, r):
    """Gradient of quaternions of some length from that of their rotation matrices ``r``, nine vectors row by row."""
    w, x, y, z = q
    gw = 2.0 * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]))
    gx = 2.0 * (w * (r[7] - r[5]) + y * (r[1] + r[3]) + z * (r[2] + r[6]) - 2.0 * x * (r[4] + r[8]))
    gy = 2.0 * (w * (r[2] - r[6]) + x * (r[1] + r[3]) + z * (r[5] + r[7]) - 2.0 * y * (r[0] + r[8]))
    gz = 2.0 * (w * (r[3] - r[1]) + x * (r[2] + r[6]) + y * (r[5] + r[7]) - 2.0 * z * (r[0] + r[4]))
    along = w * gw + x * gx + y * gy + z * gz
    scale = 1.0 / length
    return (gw - along * w) * scale, (gx - along * x) * scale, (gy - along * y) * scale, (gz - along * z) * scale


@inline
def _jacobian(camera, x_over_z, y_over_z, inverse_z):
    """The two rows of J W."""
    jx, jy = camera[FX] * inverse_z, camera[FY] * inverse_z
    return (
        (jx * (camera[0] - x_over_z * camera[6]), jx * (camera[1] - x_over_z * camera[7]),
         jx * (camera[2] - x_over_z * camera[8])),
        (jy * (camera[3] - y_over_z * camera[6]), jy * (camera[4] - y_over_z * camera[7]),
         jy * (camera[5] - y_over_z * camera[8])),
    )  # fmt: skip


@inline
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def _times(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inline
def _sum(a, x, b, y, c):
    """x a + y b + c for vectors of three and numbers x, y."""
    return x * a[0] + y * b[0] + c[0], x * a[1] + y * b[1] + c[1], x * a[2] + y * b[2] + c[2]


@inline
def _times_rotation(a, r):
    """A row of three times a rotation."""
    return (
        a[0] * r[0] + a[1] * r[3] + a[2] * r[6],
        a[0] * r[1] + a[1] * r[4] + a[2] * r[7],
        a[0] * r[2] + a[1] * r[5] + a[2] * r[8],
    )


@inline
def _covariance(eps2d, u, v):
    """a, b, c and the determinant of the blurred screen covariance, and |U x V|^2, the determinant before the blur."""
    normal = _cross(u, v)
    uu, vv = _dot(u, u), _dot(v, v)
    sharp = _dot(normal, normal)
    return uu + eps2d[0], _dot(u, v), vv + eps2d[0], sharp + eps2d[0] * (uu + vv) + eps2d[1], sharp


@inline
def _whitening(b, c, determinant):
    """first, mixed and second; products of roots, since c times the determinant may leave the range of floats."""
    second = 1.0 / sqrt(c)
    root = 1.0 / sqrt(determinant)
    return c * second * root, -(b * second) * root, second


@inline
def _block_range(center, reach, blocks):
    """First block, and block after the last, with a pixel centre within ``reach`` of ``center``; floats in range."""
    reach = reach * 1.0001 + 0.01  # more than the rounding of the bounds
    low = floor((center - reach - 0.5) * (1.0 / BLOCK))
    high = floor((center + reach - 0.5) * (1.0 / BLOCK)) + 1.0
    return minimum(maximum(low, 0.0), blocks), minimum(maximum(high, 0.0), blocks)


@inline
def box(gaussian, screen):
    """The blocks of a visible Gaussian's bounding box: left, right, top, bottom; right and bottom are exclusive."""
    left, right = np.int64(screen[gaussian, LEFT]), np.int64(screen[gaussian, RIGHT])
    return left, right, np.int64(screen[gaussian, TOP]), np.int64(screen[gaussian, BOTTOM])


@inline
def box_tiles(gaussian, screen):
    """How many tiles the bounding box of a visible Gaussian overlaps."""
    left, right, top, bottom = box(gaussian, screen)
    wide = (right + TILE_BLOCKS - 1) // TILE_BLOCKS - left // TILE_BLOCKS
    return wide * ((bottom + TILE_BLOCKS - 1) // TILE_BLOCKS - top // TILE_BLOCKS)


@inline
def _semi_axes(scales, first, rows, raw):
    """Semi-axes of sixteen Gaussians, which are given as they are or, ``raw``, as logarithms."""
    x, y, z = load_columns(scales, first, 3, rows)
    if raw:
        infinite = splat(np.float32(np.inf))  # which is never seen; so is what is not a number
        return (
            select(x <= LARGEST_LOG, exp(x), infinite),
            select(y <= LARGEST_LOG, exp(y), infinite),
            select(z <= LARGEST_LOG, exp(z), infinite),
        )
    return x, y, z


@inline
def _seen_from(camera, means, quats, scales, raw, first, rows):
    """What both passes need of sixteen Gaussians, from the row ``first`` of their arrays on.

    Returns:
        world: centres in the world; here: centres in the camera; slopes: x/z and y/z, clamped, and 1/z; q: unit
        quaternions and their lengths; rotation; rows: the two rows of J W; turned: the same times R; axes.
    """
    world = load_columns(means, first, 3, rows)
    here = _to_camera(camera, world[0], world[1], world[2])
    inverse_z = 1.0 / here[2]
    x_over_z = maximum(minimum(here[0] * inverse_z, camera[HIGHEST_X]), camera[LOWEST_X])
    y_over_z = maximum(minimum(here[1] * inverse_z, camera[HIGHEST_Y]), camera[LOWEST_Y])
    qw, qx, qy, qz = load_columns(quats, first, 4, rows)
    q, length = _unit_quaternion(qw, qx, qy, qz)
    rotation = _rotation(q)
    row_x, row_y = _jacobian(camera, x_over_z, y_over_z, inverse_z)
    turned = _times_rotation(row_x, rotation), _times_rotation(row_y, rotation)
    axes = _semi_axes(scales, first, rows, raw)
    return world, here, (x_over_z, y_over_z, inverse_z), (q, length), rotation, (row_x, row_y), turned, axes


@inline
def _largest_opacity(opacities, raw, shown, first, rows):
    """The largest opacity over the modalities. Where they are given as logits, ``raw``, all are written into ``shown``."""
    opacity = splat(0.0)
    for modality in range(opacities.shape[0]):
        (candidate,) = load_columns(opacities[modality], first, 1, rows)
        if raw:
            candidate = 1.0 / (1.0 + exp(-maximum(candidate, -LARGEST_LOG)))
            store_columns(shown[modality], first, (candidate,), rows)
        opacity = maximum(candidate, opacity)
    return opacity


@inline
def _write_visible(first, lanes, columns, screen, depths, ids, place, chunk, scratch):
    """Writes the rows of visible Gaussians and their ids from ``place`` on; returns the place after."""
    for column in range(RANK):
        store_vector(scratch, chunk * RANK + column, columns[column])
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        gaussian = first + lane
        for column in range(RANK):
            screen[gaussian, column] = scratch[chunk, column, lane]
        screen[gaussian, RANK] = place - chunk * CHUNK
        depths[gaussian] = screen[gaussian, DEPTH]
        ids[place] = gaussian
        place += 1
    return place


@inline
def _project_block(
    first, means, quats, scales, opacities, raw, camera, eps2d, width, height, antialiased,
    shown, screen, depths, means2d, radii, seen, ids, place, chunk, scratch,
):  # fmt: skip
    """Projects Gaussians ``first`` to ``first + 15``; writes visible ids from ``place`` on, returns the place after."""
    rows = means.shape[0] - first
    _, (x, y, z), (_, _, inverse_z), (_, length), _, _, turned, axes = _seen_from(
        camera, means, quats, scales, raw, first, rows
    )
    a, b, c, determinant, sharp = _covariance(eps2d, _times(turned[0], axes), _times(turned[1], axes))
    opacity = _largest_opacity(opacities, raw, shown, first, rows)
    if antialiased:
        opacity = opacity * sqrt(sharp / determinant)
    log_opacity = log2(maximum(opacity, ALPHA_MIN))

    # alpha falls to ALPHA_MIN at this many standard deviations.
    extent = sqrt(maximum(TWO_LN_2 * (log_opacity - LOG2_ALPHA_MIN), 0.0))
    reach_x, reach_y = extent * sqrt(a), extent * sqrt(c)
    radius_x, radius_y = maximum(ceil(reach_x), 1.0), maximum(ceil(reach_y), 1.0)
    mean_x = camera[FX] * x * inverse_z + camera[CX]
    mean_y = camera[FY] * y * inverse_z + camera[CY]

    # Every test is true for what is kept, so that a Gaussian with a NaN anywhere is not seen.
    visible = first_lanes(rows) & (z > 0.0) & (z >= camera[NEAR]) & (z <= camera[FAR]) & (length > 0.0)
    visible = visible & (determinant > 0.0) & (determinant <= LARGEST) & (opacity >= ALPHA_MIN)
    visible = visible & (mean_x + radius_x > 0.0) & (mean_x - radius_x < width)
    visible = visible & (mean_y + radius_y > 0.0) & (mean_y - radius_y < height)

    largest = 2.0**30  # fits an int32
    store_columns(means2d, first, (select(visible, mean_x, 0.0), select(visible, mean_y, 0.0)), rows)
    radius_x, radius_y = minimum(radius_x, largest), minimum(radius_y, largest)
    radius_x, radius_y = to_int(select(visible, radius_x, 0.0)), to_int(select(visible, radius_y, 0.0))
    store_columns(radii, first, (radius_x, radius_y), rows)

    lanes = bits(visible)
    seen[first // LANES] = lanes
    if lanes == 0:
        return place
    one, mixed, two = _whitening(b, c, determinant)
    one, mixed, two = one * WHITENING, mixed * WHITENING, two * WHITENING
    left, right = _block_range(mean_x, reach_x, (width + BLOCK - 1) // BLOCK)
    top, bottom = _block_range(mean_y, reach_y, (height + BLOCK - 1) // BLOCK)
    limit = (log_opacity - LOG2_ALPHA_MIN) * 1.001 + 1e-4  # more than the rounding of the exponent
    peak = -mixed * sqrt(limit) / (two * sqrt(mixed * mixed + two * two))
    columns = (
        mean_x, mean_y, one, mixed, two, log_opacity, z,
        select(visible, left, 0.0), select(visible, right, 0.0),
        select(visible, top, 0.0), select(visible, bottom, 0.0),
        limit, peak, -mixed / one, 1.0 / one,
    )  # fmt: skip
    return _write_visible(first, lanes, columns, screen, depths, ids, place, chunk, scratch)


@inline
def _project_chunk(
    chunk, means, quats, scales, opacities, raw, camera, width, height, antialiased,
    shown, screen, depths, means2d, radii, seen, ids, first_ranks, bounds, scratch,
):  # fmt: skip
    """Projects the Gaussians of a chunk; leaves how many are visible, and how many tiles they may touch."""
    begin = chunk * CHUNK
    place = begin
    eps2d = camera[EPS2D], camera[EPS2D_SQUARED]
    for block in range(begin, min(begin + CHUNK, means.shape[0]), LANES):
        place = _project_block(
            block, means, quats, scales, opacities, raw, camera, eps2d, width, height, antialiased,
            shown, screen, depths, means2d, radii, seen, ids, place, chunk, scratch,
        )  # fmt: skip
    first_ranks[chunk] = place - begin
    bounds[chunk] = 0
    for k in range(begin, place):
        bounds[chunk] += box_tiles(ids[k], screen)


@kernel
def project(
    means, quats, scales, opacities, raw, camera, width, height, antialiased,
    shown, screen, depths, means2d, radii, seen, ids, first_ranks, bounds, scratch,
):  # fmt: skip
    """Writes what the screen sees of each Gaussian; returns how many are visible and how many tiles they may touch.

    Args:
        means, quats, scales, opacities: [N, 3], [N, 4], [N, 3], [M, N].
        raw: whether scales and opacities are given as logarithms and logits.
        camera: [CAMERA], see above.
        shown: out [M, N], opacities, where they are given as logits.
        screen: out [N, SCREEN], rows of visible Gaussians only.
        depths: out [N], camera z of the visible ones once more, side by side.
        means2d, radii: out [N, 2]; zero where a Gaussian is not seen.
        seen: out [blocks of LANES Gaussians] int32, bits of the visible ones.
        ids: out [N] int64, begins with the visible ones, ascending.
        first_ranks: out [chunks] int64, how many visible ones there are before a chunk.
        bounds, scratch: scratch [chunks] int64 and [chunks, RANK, LANES].
    """
    chunks = first_ranks.shape[0]
    parallel_for(
        _project_chunk, chunks,
        (means, quats, scales, opacities, raw, camera, width, height, antialiased,
         shown, screen, depths, means2d, radii, seen, ids, first_ranks, bounds, scratch),
    )  # fmt: skip
    visible, tiles = np.int64(0), np.int64(0)
    for chunk in range(chunks):
        here = first_ranks[chunk]
        first_ranks[chunk] = visible
        for k in range(here):
            ids[visible + k] = ids[chunk * CHUNK + k]
        visible += here
        tiles += bounds[chunk]
    return visible, tiles


@inline
def _covariance_backward(eps2d, u, v, determinant, sharp, whitening, moments, v_log_opacity, antialiased):
    """Gradients of U and V, from the moments of g. With the whitening as a matrix L and the moments as a matrix M, that of the
    covariance is L M L^T / 2, of which twice the products with U and V are L M times the whitened rows L^T (U, V).

    Of a needle these are of order 1 across it and next to nothing along it, where first U + mixed V would leave only what
    rounding makes of two large numbers. It is first / c (c U - b V), and c U - b V = V x (U x V) + eps2d U.
    """
    one, mixed, two = whitening
    m11, m12, m22 = moments
    normal = _cross(u, v)
    across = two * v[0], two * v[1], two * v[2]
    sideways = _cross(across, (two * normal[0], two * normal[1], two * normal[2]))
    share = eps2d[0] * two * two
    along = (
        one * (sideways[0] + share * u[0]), one * (sideways[1] + share * u[1]), one * (sideways[2] + share * u[2]),
    )  # fmt: skip
    none = splat(0.0), splat(0.0), splat(0.0)
    first, second = _sum(along, m11, across, m12, none), _sum(along, m12, across, m22, none)
    through_u, through_v = none, none
    if antialiased:
        # The opacity was multiplied by sqrt(|U x V|^2 / det); |U x V|^2 is far from 0, or nothing would have been seen.
        shrink = v_log_opacity * eps2d[0] / determinant
        blurred = eps2d[0] * (_dot(u, u) + _dot(v, v)) + eps2d[1]
        spread = v_log_opacity / sharp * (blurred / determinant)
        v_normal = (spread * normal[0], spread * normal[1], spread * normal[2])
        through_u, through_v = _cross(v, v_normal), _cross(v_normal, u)
        through_u = _sum(u, -shrink, through_u, 1.0, none)
        through_v = _sum(v, -shrink, through_v, 1.0, none)
    return _sum(first, one, through_u, 1.0, none), _sum(first, mixed, second, two, through_v)


@inline
def _outer(a, b, c, d):
    """The matrix a b^T + c d^T, row by row."""
    return (
        a[0] * b[0] + c[0] * d[0], a[0] * b[1] + c[0] * d[1], a[0] * b[2] + c[0] * d[2],
        a[1] * b[0] + c[1] * d[0], a[1] * b[1] + c[1] * d[1], a[1] * b[2] + c[1] * d[2],
        a[2] * b[0] + c[2] * d[0], a[2] * b[1] + c[2] * d[1], a[2] * b[2] + c[2] * d[2],
    )  # fmt: skip


@inline
def _rotated(r, a):
    """A rotation times a column of three."""
    return _dot(a, r[0:3]), _dot(a, r[3:6]), _dot(a, r[6:9])


@inline
def _centre_backward(camera, here, slopes, jacobian, v_row_x, v_row_y, v_mean_x, v_mean_y, v_depth):
    """Gradient of the centre in the camera, from those of the rows of J W, of the mean on the screen and of depth.

    The rows are fx/z (W_0 - x/z W_2) and fy/z (W_1 - y/z W_2); clamped ratios pass no gradient.
    """
    x, y, z = here
    inverse_z = slopes[2]
    jx, jy = camera[FX] * inverse_z, camera[FY] * inverse_z
    axis = (camera[6], camera[7], camera[8])
    free_x = (x * inverse_z >= camera[LOWEST_X]) & (x * inverse_z <= camera[HIGHEST_X])
    free_y = (y * inverse_z >= camera[LOWEST_Y]) & (y * inverse_z <= camera[HIGHEST_Y])
    v_x_over_z = camera[FX] * v_mean_x - select(free_x, jx * _dot(v_row_x, axis), 0.0)
    v_y_over_z = camera[FY] * v_mean_y - select(free_y, jy * _dot(v_row_y, axis), 0.0)
    v_inverse_z = z * (_dot(v_row_x, jacobian[0]) + _dot(v_row_y, jacobian[1])) + x * v_x_over_z + y * v_y_over_z
    return v_x_over_z * inverse_z, v_y_over_z * inverse_z, v_depth - v_inverse_z * inverse_z * inverse_z


@inline
def _only(visible, vectors):
    """Three vectors where Gaussians are visible, else zero."""
    return select(visible, vectors[0], 0.0), select(visible, vectors[1], 0.0), select(visible, vectors[2], 0.0)


@inline
def _add_camera_gradient(
    v_cameras, chunk, visible, camera, world, here, slopes, jacobian, v_here, v_row_x, v_row_y, v_mean_x, v_mean_y
):
    """Adds what Gaussians tell about rotation (0-8), translation (9-11), fx, fy, cx and cy (12-15) of the camera."""
    jx, jy = camera[FX] * slopes[2], camera[FY] * slopes[2]
    for k in range(3):
        by_x, by_y = jx * v_row_x[k], jy * v_row_y[k]
        by_z = -(slopes[0] * by_x + slopes[1] * by_y)
        v_cameras[chunk, k] += np.float64(total(select(visible, by_x + v_here[0] * world[k], 0.0)))
        v_cameras[chunk, 3 + k] += np.float64(total(select(visible, by_y + v_here[1] * world[k], 0.0)))
        v_cameras[chunk, 6 + k] += np.float64(total(select(visible, by_z + v_here[2] * world[k], 0.0)))
    for k in range(3):
        v_cameras[chunk, 9 + k] += np.float64(total(v_here[k]))
    v_fx, v_cx = _intrinsics_backward(
        camera[FX], camera[LOWEST_X], camera[HIGHEST_X], here[0] * slopes[2], slopes[0], jx, camera[6:9], jacobian[0],
        v_row_x, v_mean_x,
    )  # fmt: skip
    v_fy, v_cy = _intrinsics_backward(
        camera[FY], camera[LOWEST_Y], camera[HIGHEST_Y], here[1] * slopes[2], slopes[1], jy, camera[6:9], jacobian[1],
        v_row_y, v_mean_y,
    )  # fmt: skip
    v_cameras[chunk, FX] += np.float64(total(select(visible, v_fx, 0.0)))
    v_cameras[chunk, FY] += np.float64(total(select(visible, v_fy, 0.0)))
    v_cameras[chunk, CX] += np.float64(total(select(visible, v_cx, 0.0)))
    v_cameras[chunk, CY] += np.float64(total(select(visible, v_cy, 0.0)))


@inline
def _intrinsics_backward(focal, lowest, highest, free_slope, slope, scale, axis, row, v_row, v_mean):
    """Gradients of the focal length and the principal point along one axis of the image, by way of the row f/z (W_0 - x/z W_2)
    of J W, of the mean f x/z + c, and of the limits (-c - margin) / f and (width - c + margin) / f of x/z in the row."""
    clamped = (free_slope < lowest) | (free_slope > highest)
    v_limit = select(clamped, -scale * _dot(v_row, axis), 0.0)
    return (_dot(v_row, row) - v_limit * slope) / focal + v_mean * free_slope, v_mean - v_limit / focal


@inline
def _project_block_backward(
    first, visible, sums, place, means, quats, scales, raw, camera, eps2d, antialiased,
    v_means, v_quats, v_scales, v_means2d, v_cameras, chunk,
):  # fmt: skip
    """Gradients of Gaussians ``first`` to ``first + 15`` from their sums; a name v_x stands for the gradient of x."""
    rows = means.shape[0] - first
    world, here, slopes, (q, length), rotation, jacobian, turned, axes = _seen_from(
        camera, means, quats, scales, raw, first, rows
    )
    u, v = _times(turned[0], axes), _times(turned[1], axes)
    a, b, c, determinant, sharp = _covariance(eps2d, u, v)
    whitening = _whitening(b, c, determinant)

    m1, m2, m11, m12, m22, v_depth, v_log_opacity, _unused = load_columns(sums, place // SUMS, SUMS, LANES)
    m1, m2 = m1 * INVERSE_WHITENING, m2 * INVERSE_WHITENING
    moments = m11 * TWO_LN_2, m12 * TWO_LN_2, m22 * TWO_LN_2
    v_mean_x, v_mean_y = whitening[0] * m1, whitening[1] * m1 + whitening[2] * m2
    v_u, v_v = _covariance_backward(
        eps2d, u, v, determinant, sharp, whitening, moments, v_log_opacity, antialiased
    )  # fmt: skip

    v_axes = _sum(_times(v_u, turned[0]), 1.0, _times(v_v, turned[1]), 1.0, (0.0, 0.0, 0.0))
    if raw:
        v_axes = _times(v_axes, axes)
    v_turned = _times(v_u, axes), _times(v_v, axes)
    v_quat = _rotation_backward(q, length, _outer(jacobian[0], v_turned[0], jacobian[1], v_turned[1]))
    v_row_x, v_row_y = _rotated(rotation, v_turned[0]), _rotated(rotation, v_turned[1])
    v_here = _centre_backward(
        camera, here, slopes, jacobian, v_row_x, v_row_y, v_mean_x, v_mean_y, v_depth
    )  # fmt: skip
    v_here = _only(visible, v_here)
    v_world = (
        camera[0] * v_here[0] + camera[3] * v_here[1] + camera[6] * v_here[2],
        camera[1] * v_here[0] + camera[4] * v_here[1] + camera[7] * v_here[2],
        camera[2] * v_here[0] + camera[5] * v_here[1] + camera[8] * v_here[2],
    )

    store_columns(v_means, first, v_world, rows)
    store_columns(v_scales, first, _only(visible, v_axes), rows)
    v_qx, v_qy, v_qz = _only(visible, v_quat[1:])
    store_columns(v_quats, first, (select(visible, v_quat[0], 0.0), v_qx, v_qy, v_qz), rows)
    store_columns(v_means2d, first, (select(visible, v_mean_x, 0.0), select(visible, v_mean_y, 0.0)), rows)
    if v_cameras.shape[1] > 0:
        _add_camera_gradient(
            v_cameras,
            chunk,
            visible,
            camera,
            world,
            here,
            slopes,
            jacobian,
            v_here,
            v_row_x,
            v_row_y,
            v_mean_x,
            v_mean_y,
        )


@inline
def _project_chunk_backward(
    chunk, means, quats, scales, opacities, raw, camera, antialiased, with_depth, rows_are_ranks, first_ranks, seen, spans, slots,
    sums, v_means, v_quats, v_scales, v_opacities, v_features, maps, absgrad, v_means2d, v_cameras,
):  # fmt: skip
    """``project_backward`` of the Gaussians of a chunk."""
    eps2d = camera[EPS2D], camera[EPS2D_SQUARED]
    begin, end = chunk * CHUNK, min((chunk + 1) * CHUNK, means.shape[0])
    place, row = chunk * (sums.shape[0] // v_cameras.shape[0]), first_ranks[chunk]
    fetch_slots(begin, np.int64(seen[begin // LANES]), spans, slots)
    for block in range(begin, end, LANES):
        lanes = np.int64(seen[block // LANES])
        if block + LANES < end:
            fetch_slots(block + LANES, np.int64(seen[block // LANES + 1]), spans, slots)
        clear_invisible(block, min(LANES, end - block), lanes, rows_are_ranks, v_opacities, v_features, absgrad)
        row = sum_slots(
            block, lanes, row, spans, slots, opacities, raw, with_depth, rows_are_ranks, sums, place,
            v_opacities, v_features, maps, absgrad,
        )  # fmt: skip
        _project_block_backward(
            block, mask_of(lanes), sums, place, means, quats, scales, raw, camera, eps2d, antialiased,
            v_means, v_quats, v_scales, v_means2d, v_cameras, chunk,
        )  # fmt: skip


@kernel
def project_backward(
    means, quats, scales, opacities, raw, camera, antialiased, with_depth, rows_are_ranks, first_ranks, seen, spans, slots, sums,
    v_means, v_quats, v_scales, v_opacities, v_features, maps, absgrad, v_means2d, v_cameras,
):  # fmt: skip
    """Gradients of the Gaussians from the gradient slots that compositing filled.

    Args:
        opacities: [M, N], never logits.
        raw: whether scales are logarithms, and gradients are those of logarithms and logits.
        first_ranks, seen: see ``project``.
        with_depth, rows_are_ranks: see ``binning.find_instances``.
        spans, slots: see ``slots.sum_slots``.
        sums: scratch, flat: for each chunk sixteen rows of SUMS numbers and room for a slot, in whole rows of SUMS.
        v_means, v_quats, v_scales, v_opacities, v_features, v_means2d: out, all rows are written.
        maps: out [n, S], sums of maps for the visible ones.
        absgrad: out [N, 2], or [0, 0] where it is not wanted.
        v_cameras: out, added to: [chunks, 16] rotation, translation, fx, fy, cx and cy, or [chunks, 0] where it is not wanted.
    """
    parallel_for(
        _project_chunk_backward, v_cameras.shape[0],
        (means, quats, scales, opacities, raw, camera, antialiased, with_depth, rows_are_ranks, first_ranks, seen, spans, slots,
         sums, v_means, v_quats, v_scales, v_opacities, v_features, maps, absgrad, v_means2d, v_cameras),
    )  # fmt: skip
