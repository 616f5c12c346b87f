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

from heatsplat.kernels.compilation import inline, kernel
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
    select,
    splat,
    sqrt,
    store,
    store_columns,
    to_int,
    total,
)

BLUR = np.float32(0.3)
ALPHA_MIN = np.float32(1.0 / 255.0)
CHUNK = 1024  # Gaussians per parallel task: small enough to balance, large enough that its instances stay in the cache
TILE = 16
GEOMETRY = 6

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


@inline
def _project_block(
    first, means, quats, scales, opacities, camera, width, height, antialiased,
    geometry, depths, rectangles, means2d, radii, visible, position, scratch, scratch_row,
):  # fmt: skip
    """Projects Gaussians ``first`` to ``first + 15``; returns how many tiles the visible ones may touch and where to go on
    in ``visible``."""
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
    if lanes == 0:
        return 0, position
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    left, right = _tile_range(mean_x, reach_x, tiles_x)
    top, bottom = _tile_range(mean_y, reach_y, tiles_y)
    fields = (
        mean_x, mean_y, whitening_1 * WHITENING, whitening_12 * WHITENING, whitening_2 * WHITENING, log_opacity,
        z, select(seen, left, _ZERO), select(seen, right, _ZERO), select(seen, top, _ZERO), select(seen, bottom, _ZERO),
    )  # fmt: skip
    for k in range(11):
        store(scratch, (scratch_row * 16 + k) * LANES, fields[k])
    tiles = 0
    while lanes != 0:
        k = lowest_bit(lanes)
        lanes &= lanes - 1
        gaussian = first + k
        for field in range(GEOMETRY):
            geometry[gaussian, field] = scratch[scratch_row, field, k]
        depths[gaussian] = scratch[scratch_row, 6, k]
        for field in range(4):
            rectangles[gaussian, field] = np.int32(scratch[scratch_row, 7 + field, k])
        tiles += (rectangles[gaussian, 1] - rectangles[gaussian, 0]) * (
            rectangles[gaussian, 3] - rectangles[gaussian, 2]
        )
        visible[position] = gaussian
        position += 1
    return tiles, position


@kernel
def project(
    means, quats, scales, opacities, camera, width, height, antialiased,
    geometry, depths, rectangles, means2d, radii, visible, visible_counts, tile_counts, scratch,
):  # fmt: skip
    """Writes what the screen sees of each Gaussian, and per CHUNK of them the visible ids and two counts.

    Args:
        means, quats, scales, opacities: [N, 3], [N, 4], [N, 3], [M, N].
        camera: float32 vector, see above.
        geometry: out [N, GEOMETRY], mean x and y, whitening, log2 of the largest opacity; of visible ones only.
        depths: out [N], camera z.
        rectangles: out [N, 4] int32, the tiles of the bounding box: left, right (exclusive), top, bottom (exclusive).
        means2d, radii: out [N, 2]; zero where a Gaussian is not seen.
        visible: out [N] int32; from each multiple of CHUNK on the visible ids of that chunk, ascending.
        visible_counts, tile_counts: out [chunks] int64, visible Gaussians and bounding-box tiles of each chunk.
        scratch: [chunks, 16, LANES], overwritten.
    """
    count = means.shape[0]
    for chunk in prange(visible_counts.shape[0]):
        begin = chunk * CHUNK
        position = begin
        tiles = 0
        for block in range(begin, min(begin + CHUNK, count), LANES):
            touched, position = _project_block(
                block, means, quats, scales, opacities, camera, width, height, antialiased,
                geometry, depths, rectangles, means2d, radii, visible, position, scratch, chunk,
            )  # fmt: skip
            tiles += touched
        visible_counts[chunk] = position - begin
        tile_counts[chunk] = tiles


@kernel
def gather_ids(visible, visible_counts, first_ranks, ids):
    """Writes the chunks' visible ids side by side into ``ids`` [n] int64."""
    for chunk in prange(visible_counts.shape[0]):
        for k in range(visible_counts[chunk]):
            ids[first_ranks[chunk] + k] = visible[chunk * CHUNK + k]


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


@inline
def _project_block_backward(
    first, seen, lanes, row, means, quats, scales, camera, antialiased,
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

    m1 = load(lanes, row * LANES) / WHITENING
    m2 = load(lanes, (row + 1) * LANES) / WHITENING
    m11 = load(lanes, (row + 2) * LANES) * TWO_LN_2
    m12 = load(lanes, (row + 3) * LANES) * TWO_LN_2
    m22 = load(lanes, (row + 4) * LANES) * TWO_LN_2
    v_log_opacity = load(lanes, (row + 5) * LANES)
    v_depth = load(lanes, (row + 6) * LANES)

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
def project_backward(
    means, quats, scales, opacities, camera, antialiased, has_depth, visible, visible_counts, ranges, slots,
    rows_are_ranks, first_ranks, v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, absgrad, v_cameras,
    sums, lanes,
):  # fmt: skip
    """Gradients of the Gaussians from the moments that ``compositing.composite_backward`` left in their slots.

    A Gaussian's slots lie side by side in order of its index and are summed one after the other, so the result depends
    on nothing but the image: not on threads, not on the run.

    Args:
        ranges: [N, 2], first slot of each visible Gaussian and the one after its last.
        slots: [slots, moments], see ``compositing.composite_backward``.
        rows_are_ranks, first_ranks: see ``binning.find_instances``.
        v_means ... v_means2d: out, all rows are written.
        absgrad: out [N, 2], or [0, 0] where it is not wanted.
        v_cameras: out, added to: [chunks, 12], or [chunks, 0] where it is not wanted.
        sums, lanes: scratch [chunks, moments in whole vectors] and [chunks, 7, LANES].
    """
    count = means.shape[0]
    moments, modalities, colours = slots.shape[1], opacities.shape[0], v_features.shape[1]
    opacity_sums, feature_sums = 5, 5 + modalities
    absolute_sums = feature_sums + colours + has_depth
    for chunk in prange(visible_counts.shape[0]):
        begin = chunk * CHUNK
        position, end = begin, begin + visible_counts[chunk]
        for block in range(begin, min(begin + CHUNK, count), LANES):
            for field in range(7):
                store(lanes, (chunk * 7 + field) * LANES, splat(_ZERO))
            for gaussian in range(block, min(block + LANES, count)):
                for modality in range(modalities):
                    v_opacities[modality, gaussian] = _ZERO
                for channel in range(0 if rows_are_ranks else colours):
                    v_features[gaussian, channel] = _ZERO
                for axis in range(absgrad.shape[1]):
                    absgrad[gaussian, axis] = _ZERO
            seen = 0
            while position < end and visible[position] < block + LANES:
                gaussian = np.int64(visible[position])
                lane = gaussian - block
                seen |= 1 << lane
                for field in range(0, moments, LANES):
                    summed = splat(_ZERO)
                    for slot in range(ranges[gaussian, 0], ranges[gaussian, 1]):
                        summed = summed + load(slots, slot * moments + field)
                    store(sums, chunk * sums.shape[1] + field, summed)
                for field in range(5):
                    lanes[chunk, field, lane] = sums[chunk, field]
                for modality in range(modalities):
                    v_log_opacity = sums[chunk, opacity_sums + modality]
                    opacity = opacities[modality, gaussian]
                    lanes[chunk, 5, lane] += v_log_opacity
                    v_opacities[modality, gaussian] = v_log_opacity / opacity if opacity >= ALPHA_MIN else _ZERO
                row = first_ranks[chunk] + position - begin if rows_are_ranks else gaussian
                for channel in range(colours):
                    v_features[row, channel] = sums[chunk, feature_sums + channel]
                if has_depth:
                    lanes[chunk, 6, lane] = sums[chunk, feature_sums + colours]
                for axis in range(absgrad.shape[1]):
                    absgrad[gaussian, axis] = sums[chunk, absolute_sums + axis] * TWO_LN_2
                position += 1
            _project_block_backward(
                block, mask_of(seen), lanes, chunk * 7, means, quats, scales, camera, antialiased,
                v_means, v_quats, v_scales, v_means2d, v_cameras, chunk,
            )  # fmt: skip
