"""The `cpu` backend: numba kernels behind one autograd function."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagesplat.core import sh
from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.kernels.planes import padded, to_image, to_planes
from sagesplat.kernels.workspace import Workspace
from sagesplat.raster import blend, project, sums, tiles, weights
from sagesplat.raster.render import Render
from sagesplat.scene.scene import Camera

_CHUNK = 3  # channels that one blending pass takes
_PROJECTED = 1 << 16  # Gaussians that `seen` projects at a time: only records of what is drawn are kept
_WITHOUT_PLACE = {"logit_opacities", "sh0"}  # their gradients need no projection

_Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # PARAMETERS


@dataclass(frozen=True)
class _Options:
    camera: Camera
    degree: int
    antialiased: bool
    tile_mask: np.ndarray | None
    workspace: Workspace
    trainable: np.ndarray | None = None


def _array(tensor: Tensor) -> np.ndarray:
    """A float32 tensor's memory as an array."""
    return tensor.detach().contiguous().numpy()


def _arrays(parameters: Sequence[Tensor]) -> _Arrays:
    means, quats, log_scales, logits, sh0, shN = map(_array, parameters)
    return means, quats, log_scales, logits, sh0, shN


def _enough(*arrays: np.ndarray) -> Any:
    """Arrays of as many rows as the projection kernels need at least: the last one again and again."""
    missing = project.LANES - len(arrays[0])
    if missing <= 0 or missing == project.LANES:
        return arrays
    return tuple(np.concatenate([a, a[-1:].repeat(missing, 0)]) for a in arrays)


def _project(options: _Options, parameters: Sequence[np.ndarray], first_row: int = 0):
    n = len(parameters[0])
    parameters = _enough(*parameters)
    rows, take = len(parameters[0]), options.workspace.take
    records, depths, radii = take("records", rows, blend.RECORD), take("depths", rows), take("radii", rows)
    fixed = project.camera_vector(options.camera), sh.num_bases(options.degree), options.antialiased
    project.forward(*fixed, _active(options.tile_mask), *parameters, records, depths, radii)
    records, depths, radii = records[:n], depths[:n], radii[:n]
    if n and radii.min() < 0:
        bad = np.flatnonzero(radii < 0)
        raise DataError(
            f"{len(bad)} of {n} Gaussians hold NaN or Inf (first row {first_row + bad[0]}); "
            "drop them before rendering"
        )
    return records, depths, radii


def _active(tile_mask: np.ndarray | None) -> np.ndarray:
    """How many tiles are true above and to the left of each corner; empty where all are."""
    if tile_mask is None or tile_mask.all():
        return np.zeros((0, 0), np.int64)
    return np.pad(tile_mask.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))


def _intersections(options: _Options, records: np.ndarray, depths: np.ndarray, radii: np.ndarray):
    width, height = options.camera.width, options.camera.height
    tiles_y, tiles_x = -(-height // blend.TILE), -(-width // blend.TILE)
    mask = np.ones(tiles_x * tiles_y, bool) if options.tile_mask is None else options.tile_mask.ravel()
    return tiles.intersect(records, depths, radii, width, height, mask, options.workspace)


class _Rasterize(torch.autograd.Function):
    """(parameters, features, background, means2d leaf, pose) -> rgb, alpha, features, radii."""

    @staticmethod
    def forward(
        ctx: Any,
        options: _Options,
        means2d: Tensor,
        background: Tensor,
        features: Tensor,
        pose: Tensor | None,
        *parameters: Tensor,
    ):
        camera = options.camera
        arrays = _arrays(parameters)
        records, depths, radii = _project(options, arrays)
        sums.copy_means(records, radii, means2d.detach().numpy())
        width, height, take = camera.width, camera.height, options.workspace.take
        found = _intersections(options, records, depths, radii)
        left = take("left", height, padded(width))
        ends = np.empty(len(found.starts) - 1, np.int64)
        passes = [(records, _array(background))] + [
            (_with_channels(records, _array(features), at), np.zeros(_CHUNK, np.float32))
            for at in range(0, features.shape[1], _CHUNK)
        ]
        images = []
        for index, (painted, behind) in enumerate(passes):
            image = take(f"image {index}", 3, height, padded(width))
            blend.forward(
                painted, found.starts, found.ids, found.row_order, width, height, behind, image, left, ends
            )
            images.append(image)
        ctx.save_for_backward(*parameters)
        ctx.set_materialize_grads(False)
        ctx.kept = options, [p for p, _ in passes], radii, found, ends, images, left, features.shape[1]
        extra = np.concatenate([images[0][:0], *images[1:]])[: features.shape[1]]
        ctx.mark_non_differentiable(out_radii := torch.from_numpy(radii))
        alpha = torch.from_numpy(1 - left[:, :width])
        return to_image(images[0], width), alpha, to_image(extra, width), out_radii

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        options, painted, radii, found, ends, images, left, num_features = ctx.kept
        arrays = _arrays(ctx.saved_tensors)
        g_rgb, g_alpha, g_extra = grads[:3]
        n, camera, space = len(radii), options.camera, options.workspace
        g_mean2d, g_conic = space.zeros("g_mean2d", n, 2), space.zeros("g_conic", n, 3)
        g_opacity, g_color = space.zeros("g_opacity", n), space.zeros("g_color", n, 3)
        g_features = np.zeros((n, num_features), np.float32)
        rows, reached = space.take("sums", len(found.ids), blend.SUMS), _unreached(found, space)
        to_pose = ctx.needs_input_grad[4]  # all Gaussians that are drawn have their share in it
        asked = {name for name, needs in zip(PARAMETERS, ctx.needs_input_grad[5:], strict=True) if needs}
        masked = options.trainable is not None and not to_pose
        moved = radii * options.trainable if masked else radii
        g_left, no_left = _gradient_of_left(g_alpha, left, space), left[:0]
        for index, (records, image) in enumerate(zip(painted, images, strict=True)):
            first = index == 0
            g_image, at = g_rgb if first else g_extra, _CHUNK * (index - 1)
            if not first and g_image is not None:
                g_image = g_image[..., at : at + _CHUNK]
            blend.backward(
                records, moved if masked else radii[:0], found.starts, ends, found.ids, found.slots,
                found.row_order, camera.width, image, left, _planes(g_image, left, space),
                g_left if first else no_left, reached, rows,
            )  # fmt: skip
            g_channels = g_color if first else np.zeros((n, 3), np.float32)
            found_of = records, moved, found.offsets, reached, rows
            sums.reduce(*found_of, g_mean2d, g_conic, g_opacity, g_channels)
            if not first:
                part = g_features[:, at : at + _CHUNK]
                part[:] = g_channels[:, : part.shape[1]]
        if (
            not to_pose
            and asked <= _WITHOUT_PLACE
            and not (options.antialiased and "logit_opacities" in asked)
        ):
            drawn = (moved > 0)[:, None]
            d_sh0 = np.where((painted[0][:, 6:9] > 0) & drawn, g_color, 0) * np.float32(sh.C0)
            opacity = 1 / (1 + np.exp(-arrays[3]))
            d_logits = np.where(drawn[:, 0], g_opacity * opacity * (1 - opacity), 0)
            of = {"sh0": torch.from_numpy(d_sh0[:, None]), "logit_opacities": torch.from_numpy(d_logits)}
            places = torch.from_numpy(g_mean2d), None, torch.from_numpy(g_features), None
            return None, *places, *(of.get(name) for name in PARAMETERS)
        enough: Any = _enough(*arrays)
        gradients = [
            space.take(name, *a.shape) if name != "shN" or name in asked else a[:0]
            for name, a in zip(PARAMETERS, enough, strict=True)
        ]
        num_bases = sh.num_bases(options.degree)
        if "shN" in asked and space.gradients_of != (
            n,
            num_bases,
        ):  # harmonics that are not in use stay at zero
            gradients[-1].fill(0)
            space.gradients_of = n, num_bases
        lists = _enough(painted[0], moved, g_mean2d, g_conic, g_opacity, g_color)
        fixed = project.camera_vector(camera), num_bases, options.antialiased
        d_turns = np.zeros((len(enough[0]) if to_pose else 0, 3), np.float32)
        project.backward(*fixed, *enough, *lists, *gradients, d_turns)
        gradients = [
            g[:n] for name, g in zip(PARAMETERS, gradients, strict=True) if name in asked or name != "shN"
        ]
        pose = _of_pose(camera, gradients[0], d_turns[:n]) if to_pose else None
        if to_pose and options.trainable is not None:
            for g in (g_mean2d, g_features, *gradients):
                g[~options.trainable] = 0
        return (
            None, torch.from_numpy(g_mean2d), None, torch.from_numpy(g_features), pose,
            *map(torch.from_numpy, gradients), *[None] * (len(PARAMETERS) - len(gradients)),
        )  # fmt: skip


def _unreached(found: tiles.Intersections, space: Workspace) -> np.ndarray:
    """Which intersections blending reaches, before it begins."""
    reached = space.take("reached", len(found.ids), dtype=np.bool_)
    reached.fill(False)
    return reached


def _gradient_of_left(g_alpha: Tensor | None, left: np.ndarray, space: Workspace) -> np.ndarray:
    """dL/d(remaining transmittance) [H, W'], with zeros beyond W; no rows where alpha has no gradient."""
    if g_alpha is None:
        return left[:0]
    gradient = space.zeros("g_left", *left.shape)
    gradient[:, : g_alpha.shape[1]] = -g_alpha.numpy()
    return gradient


def _planes(g_image: Tensor | None, left: np.ndarray, space: Workspace) -> np.ndarray:
    """The gradient of up to three channels as planes [3, H, W']."""
    if g_image is None:
        return space.zeros("g_image", 3, *left.shape)
    if g_image.shape[-1] < _CHUNK:
        g_image = torch.nn.functional.pad(g_image, (0, _CHUNK - g_image.shape[-1]))
    return to_planes(g_image, space, "g_image")


def _of_pose(camera: Camera, d_means: np.ndarray, d_turns: np.ndarray) -> Tensor:
    """Gradient [6] of the camera's rotation and translation: to move it is to move all means."""
    translation = camera.w2c[:3, :3].astype(np.float64) @ d_means.sum(0, dtype=np.float64)
    pose = np.concatenate([d_turns.sum(0, dtype=np.float64), translation])
    return torch.from_numpy(pose.astype(np.float32))


def _with_channels(records: np.ndarray, features: np.ndarray, at: int) -> np.ndarray:
    """Records whose colours are the features at..at+3, with zeros where there are no more."""
    painted, part = records.copy(), features[:, at : at + _CHUNK]
    painted[:, 6:9] = 0
    painted[:, 6 : 6 + part.shape[1]] = part
    return painted


def render(
    g: Gaussians,
    camera: Camera,
    *,
    degree: int,
    background: Tensor,
    features: Tensor | None,
    antialiased: bool,
    tile_mask: np.ndarray | Tensor | None,
    trainable: Tensor | None,
    pose: Tensor | None,
    workspace: Workspace | None,
) -> Render:
    """Render in float32 on the CPU; see `sagesplat.raster.rasterize` for the arguments."""
    extra = g.means.new_zeros(len(g), 0) if features is None else features
    parameters = [getattr(g, name) for name in PARAMETERS]
    posed = () if pose is None else (pose,)
    tracked = torch.is_grad_enabled() and any(p.requires_grad for p in (*parameters, extra, *posed))
    means2d = torch.zeros(len(g), 2, requires_grad=tracked)
    options = _Options(
        camera, degree, antialiased, None if tile_mask is None else np.asarray(tile_mask),
        workspace or Workspace(), None if trainable is None else trainable.numpy(),
    )  # fmt: skip
    rgb, alpha, painted, radii = _Rasterize.apply(
        options,
        means2d,
        background,
        extra,
        pose,
        *parameters,
    )  # type: ignore[misc]
    return Render(rgb, alpha, None if features is None else painted, means2d, radii)


def radii_of(
    g: Gaussians,
    camera: Camera,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: np.ndarray | None = None,
) -> np.ndarray:
    """Radii [N] px, as `Render` has them; they hold until the next call with the same `workspace`."""
    options = _Options(camera, 0, antialiased, tile_mask, workspace)
    return _project(options, _arrays([getattr(g, name) for name in PARAMETERS]))[2]


def intersections(
    g: Gaussians,
    camera: Camera,
    workspace: Workspace,
    *,
    antialiased: bool = False,
    tile_mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, tiles.Intersections]:
    """What the blending kernels take of a view: records [N, 11] (see `blend`), radii [N] px, tile lists.

    All three hold until the next call with the same `workspace`. Raises `DataError` for NaN or Inf.
    """
    options = _Options(camera, 0, antialiased, tile_mask, workspace)
    records, depths, radii = _project(options, _arrays([getattr(g, name) for name in PARAMETERS]))
    return records, radii, _intersections(options, records, depths, radii)


def seen(
    g: Gaussians,
    camera: Camera,
    workspace: Workspace,
    *,
    antialiased: bool = False,
    tile_mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, tiles.Intersections]:
    """The rows [M] of the Gaussians that are drawn, their records [M, 11] with the colours that the camera
    sees, and tile lists of places among them. The records hold until the next call with the same `workspace`,
    the lists until anything is rendered with it.
    """
    options = _Options(camera, g.sh_degree, antialiased, tile_mask, workspace)
    parameters, n, m = _arrays([getattr(g, name) for name in PARAMETERS]), len(g), 0
    rows, records = np.empty(n, np.int64), workspace.take("seen records", n, blend.RECORD)
    depths, radii = np.empty(n, np.float32), np.empty(n, np.float32)
    for begin in range(0, n, _PROJECTED):
        of_some = _project(options, [array[begin : begin + _PROJECTED] for array in parameters], begin)
        shown = np.flatnonzero(of_some[-1] > 0)
        kept = slice(m, m := m + len(shown))
        rows[kept] = begin + shown
        for array, found in zip((records, depths, radii), of_some, strict=True):
            found.take(shown, 0, out=array[kept], mode="clip")  # other modes fill an array of their own
    return rows[:m], records[:m], _intersections(options, records[:m], depths[:m], radii[:m])


def most_painted(
    g: Gaussians,
    camera: Camera,
    columns_of: np.ndarray,
    num_columns: int,
    antialiased: bool,
    space: Workspace,
    tile_mask: np.ndarray | None = None,
) -> np.ndarray:
    """See `sagesplat.raster.most_painted`."""
    records, _, found = intersections(g, camera, space, antialiased=antialiased, tile_mask=tile_mask)
    out = np.zeros((camera.height, camera.width), np.int64)
    weights.most(
        records, found.starts, found.ids, found.row_order, camera.width, camera.height,
        np.ascontiguousarray(columns_of, np.int64), num_columns, out,
    )  # fmt: skip
    return out


def add_weights(
    g: Gaussians,
    camera: Camera,
    columns_of: np.ndarray,  # int64 [H, W]
    out: np.ndarray,  # float32 [N, columns]
    *,
    antialiased: bool,
    workspace: Workspace | None,
) -> None:
    """See `sagesplat.raster.add_weights`."""
    workspace = workspace or Workspace()
    records, _, found = intersections(g, camera, workspace, antialiased=antialiased)
    rows, reached = workspace.take("weights", len(found.ids), out.shape[1]), _unreached(found, workspace)
    weights.weigh(
        records, found.starts, found.ids, found.slots, found.row_order, camera.width, camera.height,
        columns_of, reached, rows,
    )  # fmt: skip
    sums.add_by_gaussian(found.offsets, reached, rows, out)
