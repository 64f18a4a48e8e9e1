"""Per-category early stopping (Fig. 1 of the paper): a category at its target quality stops training."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Int16
from scipy.ndimage import binary_dilation

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import means_by_label, ssim_map
from sagesplat.raster import TILE, Backend, Workspace, rasterize
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.masks import Masks
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.group import ALONE, Group
from sagesplat.train.photo_loader import PhotoLoader

VIEWS = 16  # training views that a measurement takes, evenly spread: it must stay cheap
_RARE_VIEWS = 8  # that a category is measured on where fewer of those show it


def measured_views(scene: Scene, masks: Masks) -> dict[int, list[int]]:
    """Rows of the training views that each category is measured on, by label id.

    Those of 16 evenly spread ones that show it, or 8 of all that do: a few more for a rare category must not
    change what the others are measured on.
    """
    rows = scene.train_ids.tolist()
    shown = {row: np.unique(masks[scene.views[row]]).tolist() for row in rows}
    some, picked = set(spread(rows, VIEWS)), {}
    for label in sorted({label for labels in shown.values() for label in labels}):
        showing = [row for row in rows if label in shown[row]]
        among = [row for row in showing if row in some]
        picked[label] = among if len(among) >= _RARE_VIEWS else spread(showing, _RARE_VIEWS)
    return picked


def spread(rows: list[int], count: int) -> list[int]:
    """At most `count` of the rows, evenly spread."""
    return [rows[i] for i in np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)]


@dataclass(frozen=True, eq=False)
class ActiveTiles:
    """Tiles of 16 px that show a category which has not stopped; the others are not rendered."""

    scene: Scene
    masks: Masks | None  # needed once a category has stopped
    frozen: frozenset[int] = frozenset()  # label ids
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    valid: ValidPixels = ALL_VALID
    _kept: dict[tuple[int, int], np.ndarray] = field(default_factory=dict, init=False)
    _there: dict[tuple[int, int], torch.Tensor] = field(default_factory=dict, init=False)

    def tiles(self, row: int, factor: int = 1) -> Bool[np.ndarray, "h w"] | None:
        """The active tiles of a view that is rendered `factor` times smaller; None: all."""
        if not self.frozen or self.masks is None:
            return None
        if (row, factor) not in self._kept:
            view = self.scene.views[row]
            self._kept[row, factor] = active_tiles(self.masks[view], self.frozen, factor, self.valid[view])
        return self._kept[row, factor]

    def mask(self, row: int, factor: int = 1) -> Bool[np.ndarray, "h w"] | Bool[torch.Tensor, "h w"] | None:
        """The same as rasteriser and loss take it: on a GPU a tensor there."""
        tiles = self.tiles(row, factor)
        if tiles is None or self.device.type == "cpu":
            return tiles
        if (row, factor) not in self._there:
            self._there[row, factor] = torch.from_numpy(tiles).to(self.device, non_blocking=True)
        return self._there[row, factor]

    def finished(self, row: int) -> bool:
        """Whether a view shows only stopped categories."""
        tiles = self.tiles(row)
        return tiles is not None and not tiles.any()


def active_tiles(
    label_ids: Int16[np.ndarray, "H W"],
    frozen: Collection[int],
    factor: int = 1,
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """Which tiles of 16 x 16 pixels, of an image `factor` times smaller, show another than those labels.

    Pixels that are not `valid` show nothing.
    """
    height, width = label_ids.shape
    side = TILE * factor
    rows, columns = (-(-max(1, round(n / factor)) // TILE) for n in (height, width))
    learns = np.zeros((rows * side, columns * side), bool)
    moves = np.ones(2**16, bool)  # by the bits of an int16: a look-up takes a third of np.isin's time
    moves[np.array(list(frozen), np.int16).view(np.uint16)] = False
    shown = moves[label_ids.view(np.uint16)[: rows * side, : columns * side]]
    if valid is not None:
        shown &= valid[: rows * side, : columns * side]
    learns[: shown.shape[0], : shown.shape[1]] = shown
    return np.asarray(learns.reshape(rows, side, columns, side).any((1, 3)))


def label_quality(
    gaussians: Gaussians,
    active_tiles: ActiveTiles,
    photo_loader: PhotoLoader,
    views: Mapping[int, Sequence[int]],
    config: TrainConfig,
    sh_degree: int,
    *,
    backend: Backend = "auto",
    workspace: Workspace | None = None,
    group: Group = ALONE,
    camera_of: Callable[[int], Camera] | None = None,
) -> dict[int, float]:
    """Mean SSIM of each category that has not stopped, over the rows of views that `views` has for it.

    The processes of a `group` measure some views each. `camera_of`: the camera of a row of the scene's views,
    where it is not the given one.
    """
    assert active_tiles.masks is not None
    found: dict[int, dict[int, float]] = {}
    left = {label: set(rows) for label, rows in views.items() if label not in active_tiles.frozen}
    for row in group.share(sorted(set().union(*left.values()))):
        view, tiles = active_tiles.scene.views[row], active_tiles.tiles(row)
        if tiles is not None:  # windows reach into the tiles around
            tiles = binary_dilation(tiles, np.ones((3, 3)))
        with torch.no_grad():
            render = rasterize(
                gaussians, camera_of(row) if camera_of else view.camera, sh_degree=sh_degree,
                antialiased=config.antialiased, tile_mask=tiles, backend=backend, workspace=workspace,
            )  # fmt: skip
        image, (photo, _) = render.rgb.clamp(0, 1).float(), photo_loader(row)
        valid = photo_loader.valid_pixels[view]
        if (counts := photo_loader.valid(row)) is not None:
            unit = photo if photo.is_floating_point() else photo.float() / 255
            photo = torch.where(counts[..., None], unit, image)
        if image.is_cuda:
            from sagesplat.metrics import ssim_triton

            quality = ssim_triton.ssim_map(image, photo).cpu().numpy()
        else:
            quality = ssim_map(image.numpy(), photo.numpy(), tiles)
        for label, (mean, _) in means_by_label(quality, active_tiles.masks[view], valid).items():
            if row in left.get(label, ()):
                found.setdefault(label, {})[row] = mean
    values: dict[int, dict[int, float]] = {}  # by label and view, whoever measured it
    for part in group.gather(found):
        for label, by_row in part.items():
            values.setdefault(label, {}).update(by_row)
    return {label: float(np.mean([by[row] for row in sorted(by)])) for label, by in sorted(values.items())}


def trainable_rows(gaussians: Gaussians, frozen: Mapping[int, int]) -> torch.Tensor:
    """Bool [N]: the Gaussians whose category may still change."""
    labels = gaussians.label_ids
    return ~torch.isin(labels, torch.tensor(list(frozen), dtype=labels.dtype, device=labels.device))
