"""Projection kernels: 3D Gaussians to 2D ones with colours, and the gradients back.

The mathematics is that of `reference.py`, eight Gaussians at a time: geometry in float64, colours in float32.
Camera vector: w2c rotation (9, row-major), translation (3), fx, fy, cx, cy, width, height, position (3).
"""

import math
from typing import Any

import numpy as np
from numba import prange

from sagesplat.core import sh
from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import (
    count,
    double,
    exp2,
    gather,
    load8,
    log2,
    maximum,
    minimum,
    scatter,
    single,
    sqrt,
    store,
    where,
)
from sagesplat.kernels.threads import dealt
from sagesplat.raster.blend import RECORD, TILE
from sagesplat.raster.render import ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR
from sagesplat.scene.scene import Camera

LANES = 8  # the kernels need at least so many Gaussians
_LOG2E = math.log2(math.e)
_LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
_CHUNK = 256  # Gaussians that a thread takes at a time
_REACH = 1.001 * math.sqrt(-2 * math.log(ALPHA_MIN))  # standard deviations that an opacity of 1 reaches
_HUGE = 3e38  # float32's largest; what is beyond, or NaN, is not finite

_bases: Any = njit(sh.bases, forceinline=True, cache=True)
_direction_gradient: Any = njit(sh.direction_gradient, forceinline=True, cache=True)


def camera_vector(camera: Camera) -> np.ndarray:
    """What the kernels need of a camera, as one float64 vector."""
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    return np.concatenate([camera.w2c[:3, :3].ravel(), camera.w2c[:3, 3], lens, camera.position]).astype(
        np.float64
    )


@njit(forceinline=True, cache=True)
def _column(array, i, width, column):
    """A column of eight rows in float64."""
    return double(gather(array, i * width + column, width))


@njit(forceinline=True, cache=True)
def _three(array, i):
    return _column(array, i, 3, 0), _column(array, i, 3, 1), _column(array, i, 3, 2)


@njit(forceinline=True, cache=True)
def _four(array, i):
    return _column(array, i, 4, 0), _column(array, i, 4, 1), _column(array, i, 4, 2), _column(array, i, 4, 3)


@njit(forceinline=True, cache=True)
def _times_rotation(a, b, c, r):
    """(a, b, c) R^T, R row-major."""
    return a * r[0] + b * r[1] + c * r[2], a * r[3] + b * r[4] + c * r[5], a * r[6] + b * r[7] + c * r[8]


@njit(forceinline=True, cache=True)
def _finite(x):
    return (x <= _HUGE) & (x >= -_HUGE)


@njit(forceinline=True, cache=True)
def _exp(x):
    return exp2(minimum(maximum(x * _LOG2E, -1000.0), 1000.0))


@njit(forceinline=True, cache=True)
def _rotation(w, x, y, z):
    """Rotation matrix, row-major, of a unit wxyz quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@njit(forceinline=True, cache=True)
def _camera_point(cam, mx, my, mz):
    return (
        cam[0] * mx + cam[1] * my + cam[2] * mz + cam[9],
        cam[3] * mx + cam[4] * my + cam[5] * mz + cam[10],
        cam[6] * mx + cam[7] * my + cam[8] * mz + cam[11],
    )


@njit(forceinline=True, cache=True)
def _jacobian(cam, x, y, z):
    """Slopes x/z and y/z kept near the image, and J W [2 x 3]: that of the projection at the slopes."""
    fx, fy, cx, cy, width, height = cam[12], cam[13], cam[14], cam[15], cam[16], cam[17]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width, FRUSTUM_MARGIN * 0.5 * height
    u = minimum(maximum(x / z, (-cx - margin_x) / fx), (width - cx + margin_x) / fx)
    v = minimum(maximum(y / z, (-cy - margin_y) / fy), (height - cy + margin_y) / fy)
    sx, sy = fx / z, fy / z
    return u, v, (
        sx * (cam[0] - u * cam[6]), sx * (cam[1] - u * cam[7]), sx * (cam[2] - u * cam[8]),
        sy * (cam[3] - v * cam[6]), sy * (cam[4] - v * cam[7]), sy * (cam[5] - v * cam[8]),
    )  # fmt: skip


@njit(forceinline=True, cache=True)
def _half_covariance(j, r, s):
    """J W R S [2 x 3]; times its transpose it is the 2D covariance."""
    return (
        (j[0] * r[0] + j[1] * r[3] + j[2] * r[6]) * s[0],
        (j[0] * r[1] + j[1] * r[4] + j[2] * r[7]) * s[1],
        (j[0] * r[2] + j[1] * r[5] + j[2] * r[8]) * s[2],
        (j[3] * r[0] + j[4] * r[3] + j[5] * r[6]) * s[0],
        (j[3] * r[1] + j[4] * r[4] + j[5] * r[7]) * s[1],
        (j[3] * r[2] + j[4] * r[5] + j[5] * r[8]) * s[2],
    )


@njit(forceinline=True, cache=True)
def _covariance(h):
    return (
        h[0] * h[0] + h[1] * h[1] + h[2] * h[2],
        h[0] * h[3] + h[1] * h[4] + h[2] * h[5],
        h[3] * h[3] + h[4] * h[4] + h[5] * h[5],
    )


@njit(forceinline=True, cache=True)
def _direction(cam, mx, my, mz):
    """Unit vector from the camera to the mean in float32, and one over their distance."""
    dx, dy, dz = mx - cam[18], my - cam[19], mz - cam[20]
    inverse = 1.0 / sqrt(dx * dx + dy * dy + dz * dz)
    return single(dx * inverse), single(dy * inverse), single(dz * inverse), inverse


@njit(forceinline=True, cache=True)
def _store_bases(x, y, z, scratch):
    for k, basis in enumerate(_bases(x, y, z)[1:]):
        store(scratch, 8 * (k + 1), basis)


@njit(forceinline=True, cache=True)
def _shade(i, sh0, shN, num_bases, scratch):
    """Colours of eight Gaussians; the values of the bases lie in `scratch`."""
    width = 3 * shN.shape[1]
    red = 0.5 + sh.C0 * gather(sh0, 3 * i, 3)
    green = 0.5 + sh.C0 * gather(sh0, 3 * i + 1, 3)
    blue = 0.5 + sh.C0 * gather(sh0, 3 * i + 2, 3)
    for k in range(1, num_bases):
        basis, at = load8(scratch, 8 * k), i * width + 3 * k - 3
        red = red + basis * gather(shN, at, width)
        green = green + basis * gather(shN, at + 1, width)
        blue = blue + basis * gather(shN, at + 2, width)
    return red, green, blue


@njit(error_model="numpy", forceinline=True, cache=True)
def tile_box(x, y, half_width, half_height, tiles_x, tiles_y):
    """First and last + 1 tile column and row of a bounding box."""
    x0 = max(0, int(np.floor((x - half_width) / TILE)))
    x1 = min(tiles_x, int(np.floor((x + half_width) / TILE)) + 1)
    y0 = max(0, int(np.floor((y - half_height) / TILE)))
    y1 = min(tiles_y, int(np.floor((y + half_height) / TILE)) + 1)
    return x0, x1, y0, y1


@njit(error_model="numpy", cache=True)
def _meets(active, x, y, half_width, half_height, scratch):
    """1 in the lanes whose boxes hold an active tile, else 0, into the start of `scratch`."""
    store(scratch, LANES, single(x))
    store(scratch, 2 * LANES, single(y))
    store(scratch, 3 * LANES, single(half_width))
    store(scratch, 4 * LANES, single(half_height))
    tiles_y, tiles_x = len(active) - 1, active.shape[1] - 1
    for lane in range(LANES):
        scratch[lane] = 0
        if scratch[3 * LANES + lane] >= 0:  # not NaN
            x0, x1, y0, y1 = tile_box(
                scratch[LANES + lane], scratch[2 * LANES + lane], scratch[3 * LANES + lane],
                scratch[4 * LANES + lane], tiles_x, tiles_y,
            )  # fmt: skip
            if x0 < x1 and y0 < y1:
                scratch[lane] = active[y1, x1] - active[y0, x1] - active[y1, x0] + active[y0, x0] > 0


@njit(error_model="numpy", forceinline=True, cache=True)
def _forward_eight(
    i, cam, means, quats, log_scales, logits, sh0, shN, num_bases, antialiased, active, records, depths,
    radii, scratch,
):  # fmt: skip
    mx, my, mz = _three(means, i)
    w, a, b, c = _four(quats, i)
    ls0, ls1, ls2 = _three(log_scales, i)
    logit = _column(logits, i, 1, 0)
    finite = _finite(mx + my + mz) & _finite(w + a + b + c) & _finite(ls0 + ls1 + ls2 + logit)
    x, y, z = _camera_point(cam, mx, my, mz)
    px, py = cam[12] * x / z + cam[14], cam[13] * y / z + cam[15]
    opacity = 1.0 / (1.0 + _exp(-logit))
    u, v, jacobian = _jacobian(cam, x, y, z)
    s0, s1, s2 = _exp(ls0), _exp(ls1), _exp(ls2)
    # no box is larger than that of an opaque ball of the largest scale
    largest = maximum(maximum(s0, s1), s2) / z
    wide = _REACH * sqrt((largest * cam[12]) * (largest * cam[12]) * (1.0 + u * u) + BLUR)
    high = _REACH * sqrt((largest * cam[13]) * (largest * cam[13]) * (1.0 + v * v) + BLUR)
    near = (z > NEAR) & (opacity > ALPHA_MIN)
    near = near & (px + wide > 0.0) & (px - wide < cam[16]) & (py + high > 0.0) & (py - high < cam[17])
    if count(near) == 0:
        store(radii, i, single(where(finite, where(near, z, 0.0), -1.0)))
        return
    inverse = 1.0 / sqrt(w * w + a * a + b * b + c * c)
    rotation = _rotation(w * inverse, a * inverse, b * inverse, c * inverse)
    sxx, sxy, syy = _covariance(_half_covariance(jacobian, rotation, (s0, s1, s2)))
    cxx, cyy = sxx + BLUR, syy + BLUR
    det = cxx * cyy - sxy * sxy
    if antialiased:
        opacity = opacity * sqrt(maximum((sxx * syy - sxy * sxy) / det, 1e-10))
    level = log2(opacity)
    reach = 2.0 / _LOG2E * (level - _LOG2_ALPHA_MIN)
    hx, hy = sqrt(reach * cxx), sqrt(reach * cyy)
    drawn = (z > NEAR) & (opacity > ALPHA_MIN) & (det > 0.0) & _finite(det)
    drawn = drawn & (px + hx > 0.0) & (px - hx < cam[16]) & (py + hy > 0.0) & (py - hy < cam[17])
    if active.size > 0:
        _meets(active, px, py, where(drawn, hx, -1.0), hy, scratch)
        drawn = drawn & (double(load8(scratch, 0)) > 0.0)
    if count(drawn) > 0:
        dx, dy, dz, _ = _direction(cam, mx, my, mz)
        _store_bases(dx, dy, dz, scratch)
        red, green, blue = _shade(i, sh0, shN, num_bases, scratch)
        shown = double(red + green + blue)
        finite = finite & _finite(where(drawn, shown, 0.0))
        scatter(records, i * RECORD, RECORD, single(px))
        scatter(records, i * RECORD + 1, RECORD, single(py))
        scatter(records, i * RECORD + 2, RECORD, single(-0.5 * _LOG2E * cyy / det))
        scatter(records, i * RECORD + 3, RECORD, single(_LOG2E * sxy / det))
        scatter(records, i * RECORD + 4, RECORD, single(-0.5 * _LOG2E * cxx / det))
        scatter(records, i * RECORD + 5, RECORD, single(level))
        scatter(records, i * RECORD + 6, RECORD, maximum(red, 0.0))
        scatter(records, i * RECORD + 7, RECORD, maximum(green, 0.0))
        scatter(records, i * RECORD + 8, RECORD, maximum(blue, 0.0))
        scatter(records, i * RECORD + 9, RECORD, single(hx))
        scatter(records, i * RECORD + 10, RECORD, single(hy))
    radius = where(drawn, maximum(hx, hy), 0.0)
    store(radii, i, single(where(finite, radius, -1.0)))
    store(depths, i, single(where(drawn, z, np.inf)))


@njit(parallel=True, error_model="numpy", cache=True)
def forward(
    cam, num_bases, antialiased, active, means, quats, log_scales, logits, sh0, shN, records, depths, radii
):
    """Fill records [N, 11] (see `blend`), depths [N], radii [N] (0 = not drawn, -1 = not finite); N >= 8.

    active [tiles_y + 1, tiles_x + 1] counts the active tiles above and to the left; without any in its box
    a Gaussian is not drawn. Empty: all tiles are active.
    """
    n = len(means)
    chunks = (n + _CHUNK - 1) // _CHUNK
    for place in prange(chunks):
        chunk = dealt(place, chunks)
        begin, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)
        scratch = np.empty(16 * LANES, np.float32)
        for start in range(begin, end, LANES):
            # the last eight overlap those before: what is computed twice is the same
            _forward_eight(
                min(start, n - LANES), cam, means, quats, log_scales, logits, sh0, shN, num_bases,
                antialiased, active, records, depths, radii, scratch,
            )  # fmt: skip


@njit(forceinline=True, cache=True)
def _quaternion_gradient(w, x, y, z, inverse, d):
    """Gradient of the raw quaternion from that of the rotation matrix; w, x, y, z of length 1."""
    dw = 2.0 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    dx = 2.0 * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - 2.0 * x * (d[4] + d[8]))
    dy = 2.0 * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - 2.0 * y * (d[0] + d[8]))
    dz = 2.0 * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - 2.0 * z * (d[0] + d[4]))
    radial = dw * w + dx * x + dy * y + dz * z
    return (
        (dw - radial * w) * inverse, (dx - radial * x) * inverse,
        (dy - radial * y) * inverse, (dz - radial * z) * inverse,
    )  # fmt: skip


@njit(forceinline=True, cache=True)
def _load_sixteen(a):
    return (
        load8(a, 0), load8(a, 8), load8(a, 16), load8(a, 24), load8(a, 32), load8(a, 40), load8(a, 48),
        load8(a, 56), load8(a, 64), load8(a, 72), load8(a, 80), load8(a, 88), load8(a, 96), load8(a, 104),
        load8(a, 112), load8(a, 120),
    )  # fmt: skip


@njit(forceinline=True, cache=True)
def _color_gradient(i, drawn, dx, dy, dz, shN, num_bases, records, g_color, d_sh0, d_shN, scratch, weights):
    """Gradients of the coefficients; returns that of the viewing direction."""
    width = 3 * shN.shape[1]
    shown = gather(records, i * RECORD + 6, RECORD) > 0.0  # colours below 0 were cut off
    red = where(drawn & shown, gather(g_color, 3 * i, 3), 0.0)
    shown = gather(records, i * RECORD + 7, RECORD) > 0.0
    green = where(drawn & shown, gather(g_color, 3 * i + 1, 3), 0.0)
    shown = gather(records, i * RECORD + 8, RECORD) > 0.0
    blue = where(drawn & shown, gather(g_color, 3 * i + 2, 3), 0.0)
    scatter(d_sh0, 3 * i, 3, red * sh.C0)
    scatter(d_sh0, 3 * i + 1, 3, green * sh.C0)
    scatter(d_sh0, 3 * i + 2, 3, blue * sh.C0)
    _store_bases(dx, dy, dz, scratch)
    for k in range(1, num_bases):
        basis, at = load8(scratch, 8 * k), i * width + 3 * k - 3
        weight = red * gather(shN, at, width) + green * gather(shN, at + 1, width)
        store(weights, 8 * k, weight + blue * gather(shN, at + 2, width))
        if d_shN.size > 0:
            scatter(d_shN, at, width, basis * red)
            scatter(d_shN, at + 1, width, basis * green)
            scatter(d_shN, at + 2, width, basis * blue)
    return _direction_gradient(dx, dy, dz, _load_sixteen(weights))


@njit(error_model="numpy", forceinline=True, cache=True)
def _backward_eight(
    i, cam, means, quats, log_scales, logits, shN, num_bases, antialiased, records, radii,
    g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales, d_logits, d_sh0, d_shN,
    d_turns, scratch, weights,
):  # fmt: skip
    drawn32 = load8(radii, i) > 0.0
    if count(drawn32) == 0:
        d_means[i : i + LANES] = 0.0
        d_quats[i : i + LANES] = 0.0
        d_log_scales[i : i + LANES] = 0.0
        d_logits[i : i + LANES] = 0.0
        d_sh0[i : i + LANES] = 0.0
        d_shN[i : i + LANES, : num_bases - 1] = 0.0  # it may have no rows
        d_turns[i : i + LANES] = 0.0  # nor this
        return
    mx, my, mz = _three(means, i)
    qw, qx, qy, qz = _four(quats, i)
    inverse = 1.0 / sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw * inverse, qx * inverse, qy * inverse, qz * inverse
    r = _rotation(qw, qx, qy, qz)
    ls0, ls1, ls2 = _three(log_scales, i)
    s = _exp(ls0), _exp(ls1), _exp(ls2)
    x, y, z = _camera_point(cam, mx, my, mz)
    u, v, j = _jacobian(cam, x, y, z)
    h = _half_covariance(j, r, s)
    sxx, sxy, syy = _covariance(h)
    cxx, cyy = sxx + BLUR, syy + BLUR
    det = cxx * cyy - sxy * sxy
    a, b, c = cyy / det, -sxy / det, cxx / det
    # covariance = conic^-1, so d_cov = -conic g conic, with half of g_conic's xy on either side
    gxx, gxy, gyy = _column(g_conic, i, 3, 0), 0.5 * _column(g_conic, i, 3, 1), _column(g_conic, i, 3, 2)
    pxx, pxy, pyx, pyy = a * gxx + b * gxy, a * gxy + b * gyy, b * gxx + c * gxy, b * gxy + c * gyy
    dxx, dxy, dyy = -(pxx * a + pxy * b), -(pxx * b + pxy * c), -(pyx * b + pyy * c)

    opacity = 1.0 / (1.0 + _exp(-_column(logits, i, 1, 0)))
    d_opacity = _column(g_opacity, i, 1, 0)
    if antialiased:
        sharp = sxx * syy - sxy * sxy
        smooth = sharp / det > 1e-10
        compensation = where(smooth, sqrt(sharp / det), 1e-5)
        factor = where(smooth, 0.5 * d_opacity * opacity * compensation, 0.0)
        over = where(smooth, 1.0 / sharp, 0.0)
        dxx = dxx + factor * (syy * over - cyy / det)
        dyy = dyy + factor * (sxx * over - cxx / det)
        dxy = dxy + factor * (sxy / det - sxy * over)
        d_opacity = d_opacity * compensation
    scatter(d_logits, i, 1, where(drawn32, single(d_opacity * opacity * (1.0 - opacity)), 0.0))

    # d_half = 2 d_cov half, then through half = J W R S
    e = (
        2.0 * (dxx * h[0] + dxy * h[3]), 2.0 * (dxx * h[1] + dxy * h[4]), 2.0 * (dxx * h[2] + dxy * h[5]),
        2.0 * (dxy * h[0] + dyy * h[3]), 2.0 * (dxy * h[1] + dyy * h[4]), 2.0 * (dxy * h[2] + dyy * h[5]),
    )  # fmt: skip
    axes = (
        j[0] * e[0] + j[3] * e[3], j[0] * e[1] + j[3] * e[4], j[0] * e[2] + j[3] * e[5],
        j[1] * e[0] + j[4] * e[3], j[1] * e[1] + j[4] * e[4], j[1] * e[2] + j[4] * e[5],
        j[2] * e[0] + j[5] * e[3], j[2] * e[1] + j[5] * e[4], j[2] * e[2] + j[5] * e[5],
    )  # fmt: skip
    d_scale = (
        (axes[0] * r[0] + axes[3] * r[3] + axes[6] * r[6]) * s[0],
        (axes[1] * r[1] + axes[4] * r[4] + axes[7] * r[7]) * s[1],
        (axes[2] * r[2] + axes[5] * r[5] + axes[8] * r[8]) * s[2],
    )
    for k, value in enumerate(d_scale):
        scatter(d_log_scales, 3 * i + k, 3, where(drawn32, single(value), 0.0))
    d_rotation = (
        axes[0] * s[0], axes[1] * s[1], axes[2] * s[2], axes[3] * s[0], axes[4] * s[1], axes[5] * s[2],
        axes[6] * s[0], axes[7] * s[1], axes[8] * s[2],
    )  # fmt: skip
    for k, value in enumerate(_quaternion_gradient(qw, qx, qy, qz, inverse, d_rotation)):
        scatter(d_quats, 4 * i + k, 4, where(drawn32, single(value), 0.0))

    # J W = fx/z (W0 - u W2), fy/z (W1 - v W2); u = x/z unless it was kept near the image
    jx0, jx1, jx2 = _times_rotation(e[0] * s[0], e[1] * s[1], e[2] * s[2], r)
    jy0, jy1, jy2 = _times_rotation(e[3] * s[0], e[4] * s[1], e[5] * s[2], r)
    fx, fy = cam[12], cam[13]
    over_z = 1.0 / z
    along_x = jx0 * cam[6] + jx1 * cam[7] + jx2 * cam[8]
    along_y = jy0 * cam[6] + jy1 * cam[7] + jy2 * cam[8]
    d_sx = jx0 * cam[0] + jx1 * cam[1] + jx2 * cam[2] - u * along_x
    d_sy = jy0 * cam[3] + jy1 * cam[4] + jy2 * cam[5] - v * along_y
    kept_u, kept_v = (u >= x / z) & (u <= x / z), (v >= y / z) & (v <= y / z)
    d_u = where(kept_u, -fx * over_z * along_x, 0.0) + _column(g_mean2d, i, 2, 0) * fx
    d_v = where(kept_v, -fy * over_z * along_y, 0.0) + _column(g_mean2d, i, 2, 1) * fy
    d_z = -over_z * over_z * (d_sx * fx + d_sy * fy + d_u * x + d_v * y)
    d_x, d_y = d_u * over_z, d_v * over_z
    if d_turns.size > 0:  # a small turn w of the camera: x' = x + w x x, and so all columns of W
        sx, sy = fx * over_z, fy * over_z
        jx_w0, jy_w1 = d_sx + u * along_x, d_sy + v * along_y
        jx_w1 = jx0 * cam[3] + jx1 * cam[4] + jx2 * cam[5]
        jy_w0 = jy0 * cam[0] + jy1 * cam[1] + jy2 * cam[2]
        turns = (
            d_z * y - d_y * z - sx * u * jx_w1 - sy * v * jy_w1 - sy * along_y,
            d_x * z - d_z * x + sx * along_x + sx * u * jx_w0 + sy * v * jy_w0,
            d_y * x - d_x * y + sy * jy_w0 - sx * jx_w1,
        )
        for k, value in enumerate(turns):
            scatter(d_turns, 3 * i + k, 3, where(drawn32, single(value), 0.0))

    dx, dy, dz, over_distance = _direction(cam, mx, my, mz)
    gx, gy, gz = _color_gradient(
        i, drawn32, dx, dy, dz, shN, num_bases, records, g_color, d_sh0, d_shN, scratch, weights
    )
    radial = gx * dx + gy * dy + gz * dz
    d_mean = (
        cam[0] * d_x + cam[3] * d_y + cam[6] * d_z + double(gx - radial * dx) * over_distance,
        cam[1] * d_x + cam[4] * d_y + cam[7] * d_z + double(gy - radial * dy) * over_distance,
        cam[2] * d_x + cam[5] * d_y + cam[8] * d_z + double(gz - radial * dz) * over_distance,
    )
    for k, value in enumerate(d_mean):
        scatter(d_means, 3 * i + k, 3, where(drawn32, single(value), 0.0))


@njit(parallel=True, error_model="numpy", cache=True)
def backward(
    cam, num_bases, antialiased, means, quats, log_scales, logits, sh0, shN, records, radii,
    g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales, d_logits, d_sh0, d_shN, d_turns,
):  # fmt: skip
    """Gradients of all parameters from those of the 2D Gaussians; N >= 8.

    g_mean2d [N, 2]; g_conic [N, 3] for the inverse covariance's xx, xy (counted once), yy;
    g_opacity [N] of the opacity that blending saw; g_color [N, 3]. All rows are written, of d_shN
    [N, bases - 1, 3] only the first num_bases - 1. d_turns [N, 3]: of a small turn of the camera about its
    axes (rotation vector, rad). These two are left out with no rows.
    """
    n = len(means)
    chunks = (n + _CHUNK - 1) // _CHUNK
    for place in prange(chunks):
        chunk = dealt(place, chunks)
        begin, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)
        scratch, weights = np.empty(16 * LANES, np.float32), np.zeros(16 * LANES, np.float32)
        for start in range(begin, end, LANES):
            _backward_eight(
                min(start, n - LANES), cam, means, quats, log_scales, logits, shN, num_bases, antialiased,
                records, radii, g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales,
                d_logits, d_sh0, d_shN, d_turns, scratch, weights,
            )  # fmt: skip
