"""From Gaussians in the world to ellipses on the screen, sixteen at a time, and the gradients back.

Plain twin: heatsplat.renderers.reference.

Notation. W is the rotation of the camera, J the 2x3 Jacobian of the projection, R the rotation of a Gaussian, s its
semi-axes. The rows of J W R diag(s) are U and V, so that the screen covariance with its blur is

    [[a, b], [b, c]] = [[U.U, U.V], [U.V, V.V]] + BLUR I
    det = |U x V|^2 + BLUR (U.U + V.V) + BLUR^2                (Cauchy-Binet: a sum of squares, never negative)

Offsets d from the mean are whitened by the Cholesky factor of the inverse instead of multiplied by the inverse itself,

    u1 = sqrt(c / det) dx - b / sqrt(c det) dy,    u2 = dy / sqrt(c),    density = exp(-(u1^2 + u2^2) / 2),

whose exponent cannot become positive by rounding (measured on needles of axis ratio 5e4: gradient error 2e-3, against
3e-2 of the inverse form). Records store it scaled by sqrt(log2(e) / 2), which makes the density exp2(-(u1^2 + u2^2)).
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from heatsplat.kernels.compilation import inline, kernel, part
from heatsplat.kernels.simd import (
    LANES,
    absolute,
    bits,
    ceil,
    first_lanes,
    floor,
    load,
    load_columns,
    log2,
    lowest_bit,
    mask_of,
    maximum,
    minimum,
    prefetch,
    select,
    splat,
    sqrt,
    store,
    store_columns,
    store_first,
    to_int,
    total,
)

BLUR = np.float32(0.3)
ALPHA_MIN = np.float32(1.0 / 255.0)
CHUNK = 1024  # Gaussians per parallel task: small enough to balance, large enough that its instances stay in the cache
TILE = 16

# A row of ``screen``, one cache line per Gaussian: the first six numbers describe its ellipse, see above.
MEAN_X, MEAN_Y, FIRST, MIXED, SECOND, LOG_OPACITY = range(6)
GEOMETRY = 6
DEPTH, LEFT, RIGHT, TOP, BOTTOM, SLOPE_X, SLOPE_Y, RANK = range(6, 14)
SCREEN = 16

# A gradient slot: five moments of the density's gradient, the depth's gradient, the gradients of the logarithms of the
# opacities, those of the features, two absolute ones where they are wanted.
DEPTH_MOMENT = 5
OPACITY_MOMENTS = 6
# Its sum keeps the first six; the seventh is the gradient of the logarithm of all opacities at once.
LOG_OPACITY_SUM = 6
SUMS = 8
AHEAD = 16

WHITENING = np.float32(math.sqrt(math.log2(math.e) / 2.0))
LOG2_ALPHA_MIN = np.float32(-math.log2(255.0))
TWO_LN_2 = np.float32(2.0 * math.log(2.0))

_ZERO, _ONE, _TWO, _HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)


# A camera is a float32 vector, so that kernels take one argument for it: rotation 0-8 row by row, translation 9-11,
# fx fy cx cy 12-15, limits of x/z and y/z 16-19 (lowest x, highest x, lowest y, highest y), near, far 20-21.


@inline
def _to_camera(camera, x, y, z):
    """Points in camera axes."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@inline
def _unit_quaternion(w, x, y, z):
    """Quaternions of length one, and the length they had; scaled by the largest part, so that squares cannot underflow."""
    largest = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    scale = _ONE / largest
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    length = sqrt(w * w + x * x + y * y + z * z)
    scale = _ONE / length
    return w * scale, x * scale, y * scale, z * scale, largest * length


@inline
def _rotation(w, x, y, z):
    """Rotation matrices of unit quaternions, row by row."""
    return (
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip


@inline
def _jacobian(camera, inverse_z, x, y):
    """The two rows of J W; x/z and y/z are clamped to the field of view and its margin. Also returns the clamped two."""
    x_over_z = maximum(minimum(x * inverse_z, camera[17]), camera[16])
    y_over_z = maximum(minimum(y * inverse_z, camera[19]), camera[18])
    jx, jy = camera[12] * inverse_z, camera[13] * inverse_z
    return (
        jx * (camera[0] - x_over_z * camera[6]),
        jx * (camera[1] - x_over_z * camera[7]),
        jx * (camera[2] - x_over_z * camera[8]),
        jy * (camera[3] - y_over_z * camera[6]),
        jy * (camera[4] - y_over_z * camera[7]),
        jy * (camera[5] - y_over_z * camera[8]),
        x_over_z,
        y_over_z,
    )


@inline
def _times_rotation(x, y, z, r):
    """A row vector times a rotation."""
    return (
        x * r[0] + y * r[3] + z * r[6],
        x * r[1] + y * r[4] + z * r[7],
        x * r[2] + y * r[5] + z * r[8],
    )


@inline
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def _screen_covariance(u, v):
    """a, b, c and the determinant of the blurred screen covariance, and |U x V|^2, its determinant before the blur."""
    normal = _cross(u, v)
    uu, vv = _dot(u, u), _dot(v, v)
    sharp = _dot(normal, normal)
    return uu + BLUR, _dot(u, v), vv + BLUR, sharp + BLUR * (uu + vv) + BLUR * BLUR, sharp


@inline
def _whitening(a, b, c, determinant):
    """The whitening (u1 = first dx + mixed dy, u2 = second dy), in units of standard deviations."""
    inverse_root_c = _ONE / sqrt(c)
    inverse_root_det = _ONE / sqrt(determinant)
    return c * inverse_root_c * inverse_root_det, -(b * inverse_root_c) * inverse_root_det, inverse_root_c


@inline
def _tile_range(center, reach, tiles):
    """First tile and the tile after the last one that hold a pixel centre within ``reach`` of ``center``, as floats."""
    reach = reach * np.float32(1.0001) + np.float32(0.01)  # more than the rounding of the bounds
    low = floor((center - reach - _HALF) * np.float32(1.0 / TILE))
    high = floor((center + reach - _HALF) * np.float32(1.0 / TILE)) + _ONE
    tiles = np.float32(tiles)
    return minimum(maximum(low, _ZERO), tiles), minimum(maximum(high, _ZERO), tiles)


@part
def _project_block(
    first, means, quats, scales, opacities, camera, width, height, antialiased,
    screen, depths, means2d, radii, seen_lanes, ids, position, scratch, chunk,
):  # fmt: skip
    """Projects Gaussians ``first`` to ``first + 15``; returns how many tiles the visible ones may touch and where to go on
    in ``ids``."""
    rows = means.shape[0] - first
    x, y, z = load_columns(means, first, 3, rows)
    x, y, z = _to_camera(camera, x, y, z)
    inverse_z = _ONE / z
    qw, qx, qy, qz = load_columns(quats, first, 4, rows)
    qw, qx, qy, qz, length = _unit_quaternion(qw, qx, qy, qz)
    rotation = _rotation(qw, qx, qy, qz)
    sx, sy, sz = load_columns(scales, first, 3, rows)

    jx0, jx1, jx2, jy0, jy1, jy2, _, _ = _jacobian(camera, inverse_z, x, y)
    ux, uy, uz = _times_rotation(jx0, jx1, jx2, rotation)
    vx, vy, vz = _times_rotation(jy0, jy1, jy2, rotation)
    a, b, c, determinant, sharp = _screen_covariance((ux * sx, uy * sy, uz * sz), (vx * sx, vy * sy, vz * sz))
    whitening_1, whitening_12, whitening_2 = _whitening(a, b, c, determinant)

    opacity = splat(_ZERO)
    for modality in range(opacities.shape[0]):
        (candidate,) = load_columns(opacities[modality], first, 1, rows)
        opacity = maximum(candidate, opacity)
    if antialiased:
        opacity = opacity * sqrt(sharp / determinant)
    log_opacity = log2(maximum(opacity, ALPHA_MIN))

    mean_x = camera[12] * x * inverse_z + camera[14]
    mean_y = camera[13] * y * inverse_z + camera[15]
    extent = sqrt(maximum(TWO_LN_2 * (log_opacity - LOG2_ALPHA_MIN), _ZERO))
    reach_x, reach_y = extent * sqrt(a), extent * sqrt(c)
    radius_x, radius_y = maximum(ceil(reach_x), _ONE), maximum(ceil(reach_y), _ONE)

    seen = first_lanes(rows) & (z > _ZERO) & (z >= camera[20]) & (z <= camera[21]) & (length > _ZERO)
    seen = seen & (determinant > _ZERO) & (opacity >= ALPHA_MIN)
    seen = seen & (mean_x + radius_x > _ZERO) & (mean_x - radius_x < np.float32(width))
    seen = seen & (mean_y + radius_y > _ZERO) & (mean_y - radius_y < np.float32(height))

    store_columns(means2d, first, (select(seen, mean_x, _ZERO), select(seen, mean_y, _ZERO)), rows)
    largest_radius = np.float32(2.0**30)
    radius_x = to_int(select(seen, minimum(radius_x, largest_radius), _ZERO))
    radius_y = to_int(select(seen, minimum(radius_y, largest_radius), _ZERO))
    store_columns(radii, first, (radius_x, radius_y), rows)

    lanes = bits(seen)
    seen_lanes[first // LANES] = lanes
    if lanes == 0:
        return 0, position
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    left, right = _tile_range(mean_x, reach_x, tiles_x)
    top, bottom = _tile_range(mean_y, reach_y, tiles_y)
    first_u, mixed, second = whitening_1 * WHITENING, whitening_12 * WHITENING, whitening_2 * WHITENING
    fields = (
        mean_x, mean_y, first_u, mixed, second, log_opacity, z,
        select(seen, left, _ZERO), select(seen, right, _ZERO), select(seen, top, _ZERO), select(seen, bottom, _ZERO),
        -mixed / first_u, -first_u * mixed / (mixed * mixed + second * second),
    )  # fmt: skip
    for field in range(RANK):
        store(scratch, (chunk * SCREEN + field) * LANES, fields[field])
    tiles = 0
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        gaussian = first + lane
        for field in range(RANK):
            screen[gaussian, field] = scratch[chunk, field, lane]
        screen[gaussian, RANK] = position - chunk * CHUNK
        depths[gaussian] = screen[gaussian, DEPTH]
        tiles += np.int64(screen[gaussian, RIGHT] - screen[gaussian, LEFT]) * np.int64(
            screen[gaussian, BOTTOM] - screen[gaussian, TOP]
        )
        ids[position] = gaussian
        position += 1
    return tiles, position


@kernel
def project(
    means, quats, scales, opacities, camera, width, height, antialiased,
    screen, depths, means2d, radii, seen, ids, first_ranks, bounds, scratch,
):  # fmt: skip
    """Writes what the screen sees of each Gaussian; returns how many are visible and how many tiles they may touch.

    Args:
        means, quats, scales, opacities: [N, 3], [N, 4], [N, 3], [M, N].
        camera: float32 vector, see above.
        screen: out [N, SCREEN], rows of visible Gaussians only: the ellipse, camera z, the tiles of the bounding box (left,
            right, top, bottom, the second and fourth exclusive), where u1^2 + u2^2 is smallest along a line (dx per dy,
            dy per dx), and the place among the visible ones of its chunk.
        depths: out [N], camera z of the visible ones once more, side by side.
        means2d, radii: out [N, 2]; zero where a Gaussian is not seen.
        seen: out [blocks of LANES Gaussians], bits of the visible ones.
        ids: out [N] int64, begins with the visible ones, ascending.
        first_ranks: out [chunks], how many visible ones there are before a chunk.
        bounds: scratch [chunks].
        scratch: scratch [chunks, SCREEN, LANES].
    """
    count = means.shape[0]
    chunks = first_ranks.shape[0]
    for chunk in prange(chunks):
        begin = chunk * CHUNK
        position = begin
        tiles = 0
        for block in range(begin, min(begin + CHUNK, count), LANES):
            touched, position = _project_block(
                block, means, quats, scales, opacities, camera, width, height, antialiased,
                screen, depths, means2d, radii, seen, ids, position, scratch, chunk,
            )  # fmt: skip
            tiles += touched
        first_ranks[chunk] = position - begin
        bounds[chunk] = tiles
    visible = np.int64(0)
    bound = np.int64(0)
    for chunk in range(chunks):
        here = first_ranks[chunk]
        first_ranks[chunk] = visible
        for k in range(here):
            ids[visible + k] = ids[chunk * CHUNK + k]
        visible += here
        bound += bounds[chunk]
    return visible, bound


@inline
def feature_row(gaussian, screen, rows_are_ranks, first_ranks):
    """The row of a Gaussian in features that are given for all Gaussians, or for the visible ones only."""
    return first_ranks[gaussian // CHUNK] + np.int64(screen[gaussian, RANK]) if rows_are_ranks else gaussian


@inline
def _quaternion_gradient(q, length, r):
    """Gradient of unnormalised quaternions from that of their rotation matrices ``r`` (nine vectors, row by row)."""
    w, x, y, z = q
    gw = _TWO * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]))
    gx = _TWO * (w * (r[7] - r[5]) + y * (r[1] + r[3]) + z * (r[2] + r[6]) - _TWO * x * (r[4] + r[8]))
    gy = _TWO * (w * (r[2] - r[6]) + x * (r[1] + r[3]) + z * (r[5] + r[7]) - _TWO * y * (r[0] + r[8]))
    gz = _TWO * (w * (r[3] - r[1]) + x * (r[2] + r[6]) + y * (r[5] + r[7]) - _TWO * z * (r[0] + r[4]))
    along = w * gw + x * gx + y * gy + z * gz
    scale = _ONE / length
    return (gw - along * w) * scale, (gx - along * x) * scale, (gy - along * y) * scale, (gz - along * z) * scale


@part
def _project_block_backward(
    first, seen, sums, means, quats, scales, camera, antialiased,
    v_means, v_quats, v_scales, v_means2d, v_cameras, chunk,
):  # fmt: skip
    """Gradients of Gaussians ``first`` to ``first + 15`` from the moments of their densities, see ``project_backward``."""
    rows = means.shape[0] - first
    world_x, world_y, world_z = load_columns(means, first, 3, rows)
    x, y, z = _to_camera(camera, world_x, world_y, world_z)
    inverse_z = _ONE / z
    qw, qx, qy, qz = load_columns(quats, first, 4, rows)
    qw, qx, qy, qz, length = _unit_quaternion(qw, qx, qy, qz)
    rotation = _rotation(qw, qx, qy, qz)
    sx, sy, sz = load_columns(scales, first, 3, rows)
    jx0, jx1, jx2, jy0, jy1, jy2, x_over_z, y_over_z = _jacobian(camera, inverse_z, x, y)
    ux, uy, uz = _times_rotation(jx0, jx1, jx2, rotation)
    vx, vy, vz = _times_rotation(jy0, jy1, jy2, rotation)
    u, v = (ux * sx, uy * sy, uz * sz), (vx * sx, vy * sy, vz * sz)
    a, b, c, determinant, sharp = _screen_covariance(u, v)
    l1, l12, l2 = _whitening(a, b, c, determinant)

    m1, m2, m11, m12, m22, v_depth, v_log_opacity, _ = load_columns(sums, first, SUMS, rows)
    m1, m2 = m1 / WHITENING, m2 / WHITENING
    m11, m12, m22 = m11 * TWO_LN_2, m12 * TWO_LN_2, m22 * TWO_LN_2

    v_mean_x, v_mean_y = l1 * m1, l12 * m1 + l2 * m2
    mixed = l12 * m11 + l2 * m12
    p11, p12, p22 = l1 * l1 * m11, l1 * mixed, l12 * mixed + l2 * (l12 * m12 + l2 * m22)
    shrink, spread = splat(_ZERO), splat(_ZERO)
    if antialiased:
        shrink = BLUR * v_log_opacity / determinant
        spread = v_log_opacity / sharp - v_log_opacity / determinant
    normal = _cross(u, v)
    v_normal = (spread * normal[0], spread * normal[1], spread * normal[2])
    by_u, by_v = _cross(v, v_normal), _cross(v_normal, u)
    p11, p22 = p11 - shrink, p22 - shrink
    v_u = (p11 * u[0] + p12 * v[0] + by_u[0], p11 * u[1] + p12 * v[1] + by_u[1], p11 * u[2] + p12 * v[2] + by_u[2])
    v_v = (p12 * u[0] + p22 * v[0] + by_v[0], p12 * u[1] + p22 * v[1] + by_v[1], p12 * u[2] + p22 * v[2] + by_v[2])

    v_sx, v_sy, v_sz = v_u[0] * ux + v_v[0] * vx, v_u[1] * uy + v_v[1] * vy, v_u[2] * uz + v_v[2] * vz
    bu = (v_u[0] * sx, v_u[1] * sy, v_u[2] * sz)
    bv = (v_v[0] * sx, v_v[1] * sy, v_v[2] * sz)
    v_rotation = (
        jx0 * bu[0] + jy0 * bv[0], jx0 * bu[1] + jy0 * bv[1], jx0 * bu[2] + jy0 * bv[2],
        jx1 * bu[0] + jy1 * bv[0], jx1 * bu[1] + jy1 * bv[1], jx1 * bu[2] + jy1 * bv[2],
        jx2 * bu[0] + jy2 * bv[0], jx2 * bu[1] + jy2 * bv[1], jx2 * bu[2] + jy2 * bv[2],
    )  # fmt: skip
    v_qw, v_qx, v_qy, v_qz = _quaternion_gradient((qw, qx, qy, qz), length, v_rotation)
    v_jx = (_dot(bu, rotation[0:3]), _dot(bu, rotation[3:6]), _dot(bu, rotation[6:9]))
    v_jy = (_dot(bv, rotation[0:3]), _dot(bv, rotation[3:6]), _dot(bv, rotation[6:9]))

    # The rows of J W are fx/z (W0 - x/z W2) and fy/z (W1 - y/z W2); clamped ratios pass no gradient.
    jx, jy = camera[12] * inverse_z, camera[13] * inverse_z
    v_inverse_z = z * (v_jx[0] * jx0 + v_jx[1] * jx1 + v_jx[2] * jx2 + v_jy[0] * jy0 + v_jy[1] * jy1 + v_jy[2] * jy2)
    v_x_over_z = -jx * (v_jx[0] * camera[6] + v_jx[1] * camera[7] + v_jx[2] * camera[8])
    v_y_over_z = -jy * (v_jy[0] * camera[6] + v_jy[1] * camera[7] + v_jy[2] * camera[8])
    inside_x = (x * inverse_z >= camera[16]) & (x * inverse_z <= camera[17])
    inside_y = (y * inverse_z >= camera[18]) & (y * inverse_z <= camera[19])
    v_x_over_z = select(inside_x, v_x_over_z, _ZERO) + camera[12] * v_mean_x
    v_y_over_z = select(inside_y, v_y_over_z, _ZERO) + camera[13] * v_mean_y
    v_inverse_z = v_inverse_z + x * v_x_over_z + y * v_y_over_z
    v_x, v_y = v_x_over_z * inverse_z, v_y_over_z * inverse_z
    v_z = v_depth - v_inverse_z * inverse_z * inverse_z
    v_x, v_y, v_z = select(seen, v_x, _ZERO), select(seen, v_y, _ZERO), select(seen, v_z, _ZERO)

    v_world = (
        camera[0] * v_x + camera[3] * v_y + camera[6] * v_z,
        camera[1] * v_x + camera[4] * v_y + camera[7] * v_z,
        camera[2] * v_x + camera[5] * v_y + camera[8] * v_z,
    )
    store_columns(v_means, first, v_world, rows)
    store_columns(
        v_scales, first, (select(seen, v_sx, _ZERO), select(seen, v_sy, _ZERO), select(seen, v_sz, _ZERO)), rows
    )
    v_q = (select(seen, v_qw, _ZERO), select(seen, v_qx, _ZERO), select(seen, v_qy, _ZERO), select(seen, v_qz, _ZERO))
    store_columns(v_quats, first, v_q, rows)
    store_columns(v_means2d, first, (select(seen, v_mean_x, _ZERO), select(seen, v_mean_y, _ZERO)), rows)
    if v_cameras.shape[1] > 0:
        world = (world_x, world_y, world_z)
        for k in range(3):
            by_x, by_y = jx * v_jx[k], jy * v_jy[k]
            by_z = -(x_over_z * by_x + y_over_z * by_y)
            v_cameras[chunk, k] += np.float64(total(select(seen, by_x + v_x * world[k], _ZERO)))
            v_cameras[chunk, 3 + k] += np.float64(total(select(seen, by_y + v_y * world[k], _ZERO)))
            v_cameras[chunk, 6 + k] += np.float64(total(select(seen, by_z + v_z * world[k], _ZERO)))
        v_cameras[chunk, 9] += np.float64(total(v_x))
        v_cameras[chunk, 10] += np.float64(total(v_y))
        v_cameras[chunk, 11] += np.float64(total(v_z))


@kernel
def add_up_slots(
    ids, slot_starts, slots, screen, opacities, has_depth, rows_are_ranks, first_ranks,
    sums, v_opacities, v_features, absgrad,
):  # fmt: skip
    """Adds up the moments of each visible Gaussian and finishes the gradients that need no projection.

    A Gaussian's slots lie side by side and are added one after the other, so the result depends on nothing but the image:
    not on threads, not on the run.

    Args:
        ids: [n] visible Gaussians front to back, the order of the slots.
        slot_starts: [n + 1], the first slot of each of them.
        slots: [slots, moments], see ``compositing.composite_backward``; the first of each Gaussian is overwritten.
        rows_are_ranks, first_ranks: see ``binning.find_instances``.
        sums: out [N, SUMS], for ``project_backward``; rows of visible Gaussians only, as in all that follow.
        v_opacities, v_features: out [M, N] and [N or n, C].
        absgrad: out [N, 2], or [0, 0] where it is not wanted.
    """
    modalities, colours = opacities.shape[0], v_features.shape[1]
    moments = slots.shape[1]
    for rank in prange(ids.shape[0]):
        ahead = np.int64(ids[min(rank + AHEAD, ids.shape[0] - 1)])
        prefetch(sums, ahead * SUMS)
        prefetch(opacities, ahead)
        prefetch(v_opacities, ahead)
        prefetch(v_features, ahead * colours)
        gaussian = np.int64(ids[rank])
        begin, end = slot_starts[rank], slot_starts[rank + 1]
        if begin == end:
            store_first(sums, gaussian * SUMS, splat(_ZERO), SUMS)
            continue
        for field in range(0, moments, LANES):
            summed = load(slots, begin * moments + field)
            for slot in range(begin + 1, end):
                summed = summed + load(slots, slot * moments + field)
            store_first(slots, begin * moments + field, summed, moments - field)
        store_first(sums, gaussian * SUMS, load(slots, begin * moments), SUMS)
        sums[gaussian, LOG_OPACITY_SUM] = _ZERO
        for modality in range(modalities):
            v_log_opacity = slots[begin, OPACITY_MOMENTS + modality]
            opacity = opacities[modality, gaussian]
            v_opacities[modality, gaussian] = v_log_opacity / opacity if opacity >= ALPHA_MIN else _ZERO
            sums[gaussian, LOG_OPACITY_SUM] += v_log_opacity
        field = OPACITY_MOMENTS + modalities
        row = feature_row(gaussian, screen, rows_are_ranks, first_ranks)
        for channel in range(colours):
            v_features[row, channel] = slots[begin, field + channel]
        for axis in range(absgrad.shape[1]):
            absgrad[gaussian, axis] = slots[begin, field + colours + axis] * TWO_LN_2


@kernel
def project_backward(
    means, quats, scales, camera, antialiased, seen, sums, v_means, v_quats, v_scales, v_means2d, v_cameras
):  # fmt: skip
    """Gradients of the geometry from the summed moments of each Gaussian.

    Args:
        seen: [blocks], see ``project``.
        sums: [N, SUMS], see ``add_up_slots``.
        v_means ... v_means2d: out, all rows are written.
        v_cameras: out, added to: [chunks, 12], or [chunks, 0] where it is not wanted.
    """
    for chunk in prange(v_cameras.shape[0]):
        for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, means.shape[0]), LANES):
            _project_block_backward(
                block, mask_of(seen[block // LANES]), sums, means, quats, scales, camera, antialiased,
                v_means, v_quats, v_scales, v_means2d, v_cameras, chunk,
            )  # fmt: skip
