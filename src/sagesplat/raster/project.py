"""Projection kernels: 3D Gaussians to 2D ones with colours, and the gradients back.

The mathematics is that of `reference.py`, in float32, fused and parallel over Gaussians.
Camera vector: w2c rotation (9, row-major), translation (3), fx, fy, cx, cy, width, height, position (3).
"""

import math

import numpy as np
from numba import njit, prange

from sagesplat.raster.render import ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR
from sagesplat.scene.scene import Camera
from sagesplat.sh import direction_gradient, fill_bases

_LOG2E = math.log2(math.e)
_CHUNK = 256  # Gaussians that share a thread's scratch arrays


def camera_vector(camera: Camera) -> np.ndarray:
    """What the kernels need of a camera, as one float64 vector."""
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    return np.concatenate([camera.w2c[:3, :3].ravel(), camera.w2c[:3, 3], lens, camera.position]).astype(
        np.float64
    )


@njit(error_model="numpy", forceinline=True, cache=True)
def _rotation(i, quats, r):
    """Rotation matrix of a wxyz quaternion into r [3, 3]; returns 1 / |q|."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return inverse


@njit(error_model="numpy", forceinline=True, cache=True)
def _half_covariance(i, cam, means, quats, log_scales, rot, scale, jac, half):
    """Camera point, clamped slopes, J W into jac [2, 3] and J W R S into half [2, 3]."""
    x = cam[0] * means[i, 0] + cam[1] * means[i, 1] + cam[2] * means[i, 2] + cam[9]
    y = cam[3] * means[i, 0] + cam[4] * means[i, 1] + cam[5] * means[i, 2] + cam[10]
    z = cam[6] * means[i, 0] + cam[7] * means[i, 1] + cam[8] * means[i, 2] + cam[11]
    fx, fy, cx, cy, width, height = cam[12], cam[13], cam[14], cam[15], cam[16], cam[17]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width, FRUSTUM_MARGIN * 0.5 * height
    u = min(max(x / z, (-cx - margin_x) / fx), (width - cx + margin_x) / fx)
    v = min(max(y / z, (-cy - margin_y) / fy), (height - cy + margin_y) / fy)
    inverse = _rotation(i, quats, rot)
    for k in range(3):
        scale[k] = math.exp(log_scales[i, k])
        jac[0, k] = fx / z * (cam[k] - u * cam[6 + k])
        jac[1, k] = fy / z * (cam[3 + k] - v * cam[6 + k])
    for m in range(2):
        for k in range(3):
            half[m, k] = (jac[m, 0] * rot[0, k] + jac[m, 1] * rot[1, k] + jac[m, 2] * rot[2, k]) * scale[k]
    return x, y, z, u, v, inverse


@njit(error_model="numpy", forceinline=True, cache=True)
def _forward_one(
    i, cam, means, quats, log_scales, logits, sh0, shN, num_bases, antialiased, records, depths,
                radii,
    rot, scale, jac, half, basis,
):  # fmt: skip
    radii[i] = 0.0
    depths[i] = np.inf
    z = cam[6] * means[i, 0] + cam[7] * means[i, 1] + cam[8] * means[i, 2] + cam[11]
    check = means[i, 0] + means[i, 1] + means[i, 2] + logits[i] + sh0[i, 0, 0] + sh0[i, 0, 1] + sh0[i, 0, 2]
    for k in range(3):
        check += log_scales[i, k] + quats[i, k]
    if not np.isfinite(check + quats[i, 3]):
        radii[i] = -1.0
        return
    if z <= NEAR:
        return
    x, y, z, _, _, _ = _half_covariance(i, cam, means, quats, log_scales, rot, scale, jac, half)
    sxx = half[0, 0] * half[0, 0] + half[0, 1] * half[0, 1] + half[0, 2] * half[0, 2]
    sxy = half[0, 0] * half[1, 0] + half[0, 1] * half[1, 1] + half[0, 2] * half[1, 2]
    syy = half[1, 0] * half[1, 0] + half[1, 1] * half[1, 1] + half[1, 2] * half[1, 2]
    cxx, cyy = sxx + BLUR, syy + BLUR
    det = cxx * cyy - sxy * sxy
    opacity = 1.0 / (1.0 + math.exp(-logits[i]))
    if antialiased:
        opacity *= math.sqrt(max((sxx * syy - sxy * sxy) / det, 1e-10))
    if not (opacity > ALPHA_MIN and det > 0.0 and np.isfinite(det)):
        return
    mx, my = cam[12] * x / z + cam[14], cam[13] * y / z + cam[15]
    reach = 2.0 * math.log(opacity / ALPHA_MIN)
    hx, hy = math.sqrt(reach * cxx), math.sqrt(reach * cyy)
    if mx + hx <= 0 or mx - hx >= cam[16] or my + hy <= 0 or my - hy >= cam[17]:
        return
    depths[i] = z
    radii[i] = max(hx, hy)
    records[i, 0], records[i, 1] = mx, my
    records[i, 2], records[i, 3], records[i, 4] = (
        -0.5 * _LOG2E * cyy / det,
        _LOG2E * sxy / det,
        -0.5 * _LOG2E * cxx / det,
    )
    records[i, 5] = math.log2(opacity)
    dx, dy, dz = means[i, 0] - cam[18], means[i, 1] - cam[19], means[i, 2] - cam[20]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    fill_bases(dx / length, dy / length, dz / length, num_bases, basis)
    red = 0.5 + basis[0] * sh0[i, 0, 0]
    green = 0.5 + basis[0] * sh0[i, 0, 1]
    blue = 0.5 + basis[0] * sh0[i, 0, 2]
    for k in range(1, num_bases):
        red += basis[k] * shN[i, k - 1, 0]
        green += basis[k] * shN[i, k - 1, 1]
        blue += basis[k] * shN[i, k - 1, 2]
    if not np.isfinite(red + green + blue):
        radii[i] = -1.0
        return
    records[i, 6], records[i, 7], records[i, 8] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
    records[i, 9], records[i, 10] = hx, hy


@njit(parallel=True, error_model="numpy", cache=True)
def forward(cam, means, quats, log_scales, logits, sh0, shN, num_bases, antialiased, records, depths, radii):
    """Fill records [N, 11] (see `blend`), depths [N] and radii [N] (0 = not drawn, -1 = not finite)."""
    for chunk in prange((len(means) + _CHUNK - 1) // _CHUNK):
        rot, scale = np.empty((3, 3)), np.empty(3)
        jac, half, basis = np.empty((2, 3)), np.empty((2, 3)), np.empty(16)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(means))):
            _forward_one(
                i, cam, means, quats, log_scales, logits, sh0, shN, num_bases, antialiased, records, depths,
                radii,
                rot, scale, jac, half, basis,
            )  # fmt: skip


@njit(error_model="numpy", forceinline=True, cache=True)
def _quaternion_gradient(i, quats, inverse, d, out):
    """d [3, 3] of the rotation matrix to the raw quaternion's gradient."""
    w, x, y, z = (
        quats[i, 0] * inverse, quats[i, 1] * inverse, quats[i, 2] * inverse, quats[i, 3] * inverse,
    )  # fmt: skip
    dw = 2 * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]))
    dx = 2 * (
        y * (d[0, 1] + d[1, 0])
        + z * (d[0, 2] + d[2, 0])
        + w * (d[2, 1] - d[1, 2])
        - 2 * x * (d[1, 1] + d[2, 2])
    )
    dy = 2 * (
        x * (d[0, 1] + d[1, 0])
        + z * (d[1, 2] + d[2, 1])
        + w * (d[0, 2] - d[2, 0])
        - 2 * y * (d[0, 0] + d[2, 2])
    )
    dz = 2 * (
        x * (d[0, 2] + d[2, 0])
        + y * (d[1, 2] + d[2, 1])
        + w * (d[1, 0] - d[0, 1])
        - 2 * z * (d[0, 0] + d[1, 1])
    )
    radial = dw * w + dx * x + dy * y + dz * z
    out[i, 0], out[i, 1] = (dw - radial * w) * inverse, (dx - radial * x) * inverse
    out[i, 2], out[i, 3] = (dy - radial * y) * inverse, (dz - radial * z) * inverse


@njit(error_model="numpy", forceinline=True, cache=True)
def _color_gradient(i, cam, means, shN, num_bases, records, g_color, d_means, d_sh0, d_shN, basis, weights):
    """Gradients of the coefficients, and of the mean through the viewing direction."""
    dx, dy, dz = means[i, 0] - cam[18], means[i, 1] - cam[19], means[i, 2] - cam[20]
    inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    fill_bases(dx, dy, dz, num_bases, basis)
    red = g_color[i, 0] if records[i, 6] > 0 else 0.0
    green = g_color[i, 1] if records[i, 7] > 0 else 0.0
    blue = g_color[i, 2] if records[i, 8] > 0 else 0.0
    d_sh0[i, 0, 0], d_sh0[i, 0, 1], d_sh0[i, 0, 2] = basis[0] * red, basis[0] * green, basis[0] * blue
    for k in range(1, num_bases):
        d_shN[i, k - 1, 0] = basis[k] * red
        d_shN[i, k - 1, 1] = basis[k] * green
        d_shN[i, k - 1, 2] = basis[k] * blue
        weights[k] = red * shN[i, k - 1, 0] + green * shN[i, k - 1, 1] + blue * shN[i, k - 1, 2]
    gx, gy, gz = direction_gradient(dx, dy, dz, num_bases, weights)
    radial = gx * dx + gy * dy + gz * dz
    d_means[i, 0] += (gx - radial * dx) * inverse
    d_means[i, 1] += (gy - radial * dy) * inverse
    d_means[i, 2] += (gz - radial * dz) * inverse


@njit(error_model="numpy", forceinline=True, cache=True)
def _backward_one(
    i, cam, means, quats, log_scales, logits, shN, num_bases, antialiased, records,
    g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales, d_logits, d_sh0, d_shN,
    rot, scale, d_rot, jac, half, d_half, d_jac, basis, weights,
):  # fmt: skip
    x, y, z, u, v, inverse = _half_covariance(i, cam, means, quats, log_scales, rot, scale, jac, half)
    fx, fy = cam[12], cam[13]
    sxx = half[0, 0] * half[0, 0] + half[0, 1] * half[0, 1] + half[0, 2] * half[0, 2]
    sxy = half[0, 0] * half[1, 0] + half[0, 1] * half[1, 1] + half[0, 2] * half[1, 2]
    syy = half[1, 0] * half[1, 0] + half[1, 1] * half[1, 1] + half[1, 2] * half[1, 2]
    cxx, cyy = sxx + BLUR, syy + BLUR
    det = cxx * cyy - sxy * sxy
    a, b, c = cyy / det, -sxy / det, cxx / det
    # covariance = conic^-1, so d_cov = -conic g conic, with half of g_conic's xy on either side
    gxx, gxy, gyy = g_conic[i, 0], 0.5 * g_conic[i, 1], g_conic[i, 2]
    pxx, pxy, pyx, pyy = a * gxx + b * gxy, a * gxy + b * gyy, b * gxx + c * gxy, b * gxy + c * gyy
    dxx, dxy, dyy = -(pxx * a + pxy * b), -(pxx * b + pxy * c), -(pyx * b + pyy * c)

    opacity = 1.0 / (1.0 + math.exp(-logits[i]))
    d_opacity = g_opacity[i]
    sharp = sxx * syy - sxy * sxy
    if antialiased and sharp / det > 1e-10:
        compensation = math.sqrt(sharp / det)
        factor = 0.5 * d_opacity * opacity * compensation
        dxx += factor * (syy / sharp - cyy / det)
        dyy += factor * (sxx / sharp - cxx / det)
        dxy += factor * (sxy / det - sxy / sharp)
        d_opacity *= compensation
    elif antialiased:
        d_opacity *= 1e-5
    d_logits[i] = d_opacity * opacity * (1.0 - opacity)

    for k in range(3):
        d_half[0, k] = 2 * (dxx * half[0, k] + dxy * half[1, k])
        d_half[1, k] = 2 * (dxy * half[0, k] + dyy * half[1, k])
    for k in range(3):
        along = 0.0
        for j in range(3):
            d_axis = jac[0, j] * d_half[0, k] + jac[1, j] * d_half[1, k]
            along += d_axis * rot[j, k]
            d_rot[j, k] = d_axis * scale[k]
        d_log_scales[i, k] = along * scale[k]
    for m in range(2):
        for j in range(3):
            d_jac[m, j] = (
                d_half[m, 0] * rot[j, 0] * scale[0]
                + d_half[m, 1] * rot[j, 1] * scale[1]
                + d_half[m, 2] * rot[j, 2] * scale[2]
            )

    # jac[0] = fx/z (W0 - u W2), jac[1] = fy/z (W1 - v W2); u = x/z unless clamped
    d_fx_z = d_fy_z = d_u = d_v = 0.0
    for j in range(3):
        d_fx_z += d_jac[0, j] * (cam[j] - u * cam[6 + j])
        d_fy_z += d_jac[1, j] * (cam[3 + j] - v * cam[6 + j])
        d_u -= d_jac[0, j] * fx / z * cam[6 + j]
        d_v -= d_jac[1, j] * fy / z * cam[6 + j]
    if u != x / z:
        d_u = 0.0
    if v != y / z:
        d_v = 0.0
    d_u += g_mean2d[i, 0] * fx
    d_v += g_mean2d[i, 1] * fy
    dz = -(d_fx_z * fx + d_fy_z * fy) / (z * z) - (d_u * x + d_v * y) / (z * z)
    dx, dy = d_u / z, d_v / z
    for k in range(3):
        d_means[i, k] = cam[k] * dx + cam[3 + k] * dy + cam[6 + k] * dz
    _quaternion_gradient(i, quats, inverse, d_rot, d_quats)
    _color_gradient(i, cam, means, shN, num_bases, records, g_color, d_means, d_sh0, d_shN, basis, weights)


@njit(parallel=True, error_model="numpy", cache=True)
def backward(
    cam, means, quats, log_scales, logits, sh0, shN, num_bases, antialiased, records, radii,
    g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales, d_logits, d_sh0, d_shN,
):  # fmt: skip
    """Gradients of all parameters from those of the 2D Gaussians.

    g_mean2d [N, 2]; g_conic [N, 3] for the inverse covariance's xx, xy (counted once), yy;
    g_opacity [N] of the opacity that blending saw; g_color [N, 3]. Outputs must come in as zeros.
    """
    for chunk in prange((len(means) + _CHUNK - 1) // _CHUNK):
        rot, scale, d_rot = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        jac, half, d_half, d_jac = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
        basis, weights = np.empty(16), np.zeros(16)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(means))):
            if radii[i] > 0:
                _backward_one(
                    i, cam, means, quats, log_scales, logits, shN, num_bases, antialiased, records,
                    g_mean2d, g_conic, g_opacity, g_color, d_means, d_quats, d_log_scales, d_logits, d_sh0,
                    d_shN, rot, scale, d_rot, jac, half, d_half, d_jac, basis, weights,
                )  # fmt: skip
