"""Spark: its tree of levels, its choice of splats, its RAD encoding, and how its merged splats are drawn.

All of sparkjsdev/spark at 2.2.0 (MIT licence; described, not copied):

- Tree: `rust/spark-lib/src/bhatt_lod.rs`, which its manual recommends (`build-lod --quality`), built by the
  package itself (`spark_tree.py`). An inner splat is the mean of those below it, each weighted by its mass:
  opacity times the surface of its ellipsoid.
- Choice: `traverse_lod_trees` in `rust/spark-rs/src/lod_tree.rs`. From the root on, the splat that looks
  largest is replaced by its children, until none looks larger than a pixel, or the next would exceed the
  budget. A splat's look is its size over its distance (size: twice the largest standard deviation, times what
  an opacity above 1 widens it by). Foveation multiplies that by 1 within a cone of 90 degrees around the view
  direction, falling to 0.4 at 120 degrees and to 0.2 sideways and behind (`SparkRenderer.ts`: coneFov0,
  coneFov, coneFoveate, behindFoveate). The falls are linear in the cosine.
- Pages: 65,536 splats of a RAD file in the tree's order; needed is that of the root, and those of the
  children of every splat that was replaced.
- Bytes: of RAD's automatic encodings (`rust/spark-lib/src/rad.rs`), as the package itself writes no files.
  What they round is not rounded here, in its favour: on the demo that is 0.0005 of fidelity.
- Opacity A above 1 (`shaders/splatVertex.glsl`, `splatFragment.glsl`): D = sqrt(1 + e ln A) is stored as
  1 + (D - 1) / 4; the antialiasing filter multiplies D; alpha is 1 - (1 - G)^A for the Gaussian G.
"""

import heapq
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from benchmarks.runtime.measure import Shown
from sagesplat.adapt.observe import render_rgb
from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.kernels.jit import njit
from sagesplat.raster import Backend, Workspace
from sagesplat.raster.reference import projected
from sagesplat.scene.scene import Camera

PAGE = 65536
FOVEATION = (90.0, 120.0, 0.4, 0.2)  # coneFov0, coneFov (degrees), coneFoveate, behindFoveate
NO_FOVEATION = (180.0, 180.0, 1.0, 1.0)
_COPIES = 12  # that an opacity above 1 is drawn as, at most: beyond that they are wider
_OPAQUE = 1 - 1e-6
_PAGE_HEAD, _FILE_HEAD = 1500, 700  # bytes of JSON, about


@dataclass(frozen=True, eq=False)
class Tree:
    """Spark's tree: the root first, children of a splat together and after it."""

    splats: Gaussians  # whose opacities are `opacity`, and not their own
    opacity: np.ndarray  # [N]; above 1 it is D
    centre: np.ndarray  # float32 [N, 3], as the choice has it: half floats
    size: np.ndarray  # float32 [N]
    first: np.ndarray  # int64 [N], first child
    children: np.ndarray  # int64 [N], how many


def decoded(arrays: dict[str, np.ndarray], model: Gaussians) -> Tree:
    """The tree of `spark_tree.built`, of a model.

    Its harmonics are computed from the model's: those that the arrays hold were cut off at powers of two.
    """
    ext0, ext1, tree = arrays["ext0"], arrays["ext1"], arrays["lodTree"]
    means = np.ascontiguousarray(ext0[:, :3]).view(np.float32)
    scales = np.stack([_half(ext1[:, 1], 1), _half(ext1[:, 2], 0), _half(ext1[:, 2], 1)], 1)
    colour = np.stack([_half(ext1[:, 0], 0), _half(ext1[:, 0], 1), _half(ext1[:, 1], 0)], 1)
    stored, first, children = _half(ext0[:, 3], 0), tree[:, 3], tree[:, 2] & 0xFFFF
    first, children = first.astype(np.int64), children.astype(np.int64)
    opacity = np.where(stored > 1, np.minimum(4 * stored - 3, 5), stored).astype(np.float64)
    shN = np.zeros((len(means), *model.shN.shape[1:]), np.float32)
    if shN.size:
        of = {key: i for i, key in enumerate(_keys(model.means.numpy(), model.log_scales.numpy()))}
        leaves = np.flatnonzero(children == 0)
        keys = list(_keys(means[leaves], scales[leaves]))
        if lost := sum(key not in of for key in keys):
            raise SystemExit(f"Spark's tree has {lost} splats without children that the model does not have")
        shN[leaves] = model.shN.numpy()[[of[key] for key in keys]]
        mass = opacity * _surface(np.exp(scales.astype(np.float64)))
        total, weighted = np.where(children == 0, mass, 0), shN.reshape(len(means), -1) * mass[:, None]
        for node in np.flatnonzero(children)[::-1].tolist():
            below = slice(first[node], first[node] + children[node])
            total[node], weighted[node] = total[below].sum(), weighted[below].sum(0)
        shN = (weighted / np.maximum(total, 1e-30)[:, None]).astype(np.float32).reshape(shN.shape)
    splats = Gaussians(
        torch.from_numpy(means.copy()),
        torch.from_numpy(_quaternions(ext1[:, 3])),
        torch.from_numpy(scales),
        torch.zeros(len(means)),
        torch.from_numpy((colour - 0.5) / np.float32(sh.C0))[:, None],
        torch.from_numpy(shN),
        torch.full((len(means),), -1, dtype=torch.int16),
    )
    centre = np.stack([_half(tree[:, 0], 0), _half(tree[:, 0], 1), _half(tree[:, 1], 0)], 1)
    return Tree(splats, opacity, centre, _half(tree[:, 1], 1), first, children)


def _half(words: np.ndarray, high: int) -> np.ndarray:
    """Float32 of the half floats in the lower or the upper 16 bits."""
    return (words >> 16 * high & 0xFFFF).astype(np.uint16).view(np.float16).astype(np.float32)


def _keys(means: np.ndarray, log_scales: np.ndarray) -> Iterator[bytes]:
    """What a splat is known by."""
    rounded = log_scales.astype(np.float16).view(np.uint16).astype(np.uint32)
    rows = np.concatenate([np.ascontiguousarray(means).view(np.uint32), rounded], 1)
    return (row.tobytes() for row in rows)


def _surface(scales: np.ndarray) -> np.ndarray:
    """Of ellipsoids, by Thomsen's formula."""
    x, y, z = scales.T
    p = 1.6075
    return 4 * math.pi * (((x * y) ** p + (x * z) ** p + (y * z) ** p) / 3) ** (1 / p)


def _quaternions(words: np.ndarray) -> np.ndarray:
    """Wxyz of an octahedral axis of 10 + 10 bits and an angle of 12."""
    x, y = (2 * (words >> shift & 0x3FF) / 1023 - 1 for shift in (0, 10))
    angle = math.pi * (words >> 20) / 4095
    z = 1 - np.abs(x) - np.abs(y)
    over = np.maximum(-z, 0)
    axis = np.stack([x - np.copysign(over, x), y - np.copysign(over, y), z], 1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turned = np.concatenate([np.cos(angle / 2)[:, None], axis * np.sin(angle / 2)[:, None]], 1)
    return turned.astype(np.float32)


def page_bytes(tree: Tree) -> np.ndarray:
    """What each page of a RAD file takes, int64 [P]."""
    g, n = tree.splats, len(tree.splats)
    scales, colour = g.log_scales.numpy(), 0.5 + sh.C0 * g.sh0.numpy()[:, 0]
    stored = np.where(tree.opacity > 1, 1 + (tree.opacity - 1) / 4, tree.opacity)
    columns = [
        g.means.numpy().view(np.uint8).reshape(n, 3, 4).transpose(2, 1, 0).reshape(12, n),
        stored.astype(np.float16)[None],
        np.diff(_steps(colour, *_within(colour, 0.0, 1.0), 255).T, axis=1, prepend=np.uint8(0)),
        _steps(scales, *_within(np.sort(scales, 1)[:, 1:], -12.0, 9.0), 254).T + np.uint8(1),
        _turns(g.quats.numpy()),
    ]
    begin = 0
    for bases in (3, 5, 7):
        part = g.shN.numpy()[:, begin : begin + bases].reshape(n, -1)
        if part.size:
            most = max(1.0, float(np.abs(np.quantile(part, [0.05, 0.95])).max()))
            columns.append(np.clip(np.round(part / most * 127), -127, 127).astype(np.int8).T)
        begin += bases
    columns += [tree.children.astype(np.uint16)[None], tree.first.astype(np.uint32)[None]]
    # one dimension after the other, but the three bytes of a rotation together: they are rows
    pages = [
        [(one[at : at + PAGE] if len(one) == n else one[:, at : at + PAGE]).tobytes() for one in columns]
        for at in range(0, n, PAGE)
    ]
    return np.array([_PAGE_HEAD + sum(map(_deflated, page)) for page in pages])


def _within(values: np.ndarray, low: float, high: float) -> tuple[float, float]:
    """The range that all but the outermost hundredths are in, and at least that from low to high."""
    lower, upper = np.quantile(values, [0.01, 0.99])
    return min(float(lower), low), max(float(upper), high)


def _steps(values: np.ndarray, low: float, high: float, most: int) -> np.ndarray:
    return np.clip(np.round((values - low) / (high - low) * most), 0, most).astype(np.uint8)


def _turns(quats: np.ndarray) -> np.ndarray:
    """Two bytes of the axis on the octahedron, and one of the angle, of quaternions [N, 4]."""
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    q = np.where(q[:, :1] < 0, -q, q)
    axis = q[:, 1:] / np.maximum(np.abs(q[:, 1:]).sum(1, keepdims=True), 1e-6)
    p = axis[:, :2]
    p = np.where(axis[:, 2:] < 0, (1 - np.abs(p[:, ::-1])) * np.where(p >= 0, 1, -1), p)
    angle = 2 * np.arccos(np.clip(q[:, 0], 0, 1))
    return np.concatenate([_steps(p, -1, 1, 255), _steps(angle, 0, math.pi, 255)[:, None]], 1)


def _deflated(content: bytes) -> int:
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    return len(packer.compress(content) + packer.flush()) + 7 & ~7


@njit(cache=True)
def traverse(centre, size, first, children, at, forward, cones, budget, limit):
    """Rows that are chosen, and whether each page is needed; `cones`: cosines of both, and both factors."""
    chosen, n = np.empty(len(size), np.int64), 0
    pages = np.zeros((len(size) + PAGE - 1) // PAGE, np.bool_)
    pages[0] = True
    frontier = [(-look_of(centre, size, 0, at, forward, cones), np.int64(0))]
    count = 1
    while frontier:
        large, node = frontier[0]
        if -large <= limit:
            break
        if children[node] == 0:
            heapq.heappop(frontier)
            chosen[n] = node
            n += 1
            continue
        if count - 1 + children[node] > budget:
            break
        heapq.heappop(frontier)
        begin, end = first[node], first[node] + children[node]
        pages[begin // PAGE] = pages[(end - 1) // PAGE] = True
        for child in range(begin, end):
            large = look_of(centre, size, child, at, forward, cones)
            if large <= limit:
                chosen[n] = child
                n += 1
            else:
                heapq.heappush(frontier, (-large, np.int64(child)))
        count += children[node] - 1
    for _, node in frontier:
        chosen[n] = node
        n += 1
    return chosen[:n], pages


@njit(cache=True)
def look_of(centre, size, node, at, forward, cones):
    """How large a splat looks."""
    d = centre[node] - at
    distance = max(math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-6)
    inner, outer, at_outer, behind = cones
    cosine = (d[0] * forward[0] + d[1] * forward[1] + d[2] * forward[2]) / distance
    if cosine <= 0:
        factor = behind
    elif cosine >= inner:
        factor = 1.0
    elif cosine >= outer:
        factor = at_outer + (1 - at_outer) * (cosine - outer) / (inner - outer)
    else:
        factor = behind + (at_outer - behind) * cosine / outer
    return factor * size[node] / distance


def wide(g: Gaussians, opacity: np.ndarray, camera: Camera, antialiased: bool) -> Gaussians:
    """Plain Gaussians that look as the splats do, to be drawn without the antialiasing filter.

    (1 - G)^A is drawn as copies of an opaque G, and one of the rest of A; beyond 12 copies they are wider, so
    that half of the light passes at the same distance. Within 0.04 of it up to A = 17.
    """
    if antialiased:
        opaque = replace(g, logit_opacities=torch.full_like(g.logit_opacities, 20.0))
        *_, share = projected(opaque, camera, torch.tensor(camera.w2c).double(), True)
        opacity = opacity * share.numpy()
    power = np.where(opacity > 1, np.exp((opacity**2 - 1) / math.e), 1.0)
    many = np.minimum(power, _COPIES)
    wider = _half_reach(power) / _half_reach(many)
    copies = np.where(opacity > 1, np.floor(many), 0).astype(np.int64)
    rest = np.where(opacity > 1, 2 - 2 ** (1 + np.floor(many) - many), opacity)
    rows = np.concatenate([np.repeat(np.arange(len(g)), copies), np.flatnonzero(rest > 0)])
    values = np.concatenate([np.ones(copies.sum()), rest[rest > 0]])
    out = g.select(torch.from_numpy(rows))
    logits = torch.logit(torch.from_numpy(np.minimum(values, _OPAQUE)).float())
    wider_by = torch.from_numpy(np.log(wider[rows])).float()[:, None]
    return replace(out, logit_opacities=logits, log_scales=out.log_scales + wider_by)


def _half_reach(power: np.ndarray) -> np.ndarray:
    """Standard deviations at which (1 - G)^power is a half."""
    return np.sqrt(-2 * np.log(1 - 0.5 ** (1 / power)))


class SparkTree:
    """A method of `measure`: the knob is the splat budget."""

    targets: Sequence[float] = ()

    def __init__(
        self,
        name: str,
        tree: Tree,
        budgets: Sequence[float],
        foveation: tuple[float, float, float, float],
        backend: Backend,
        antialiased: bool,
    ):
        self.name, self.settings = name, budgets
        self._tree, self.piece_bytes, self.index_bytes = tree, page_bytes(tree), _FILE_HEAD
        inner, outer, at_outer, behind = foveation
        cosines = (math.cos(math.radians(angle / 2)) for angle in (inner, outer))
        self._cones = (*cosines, at_outer, behind)
        self._backend: Backend = backend
        self._antialiased, self._space = antialiased, Workspace()

    def shown(self, frame: int, camera: Camera) -> Iterator[Shown]:
        """See `Method`."""
        tree, limit = self._tree, 1 / float(camera.K[1, 1])
        for budget in self.settings:
            rows, pages = traverse(
                tree.centre, tree.size, tree.first, tree.children, camera.position, camera.direction,
                self._cones, budget, limit,
            )  # fmt: skip
            g = wide(
                tree.splats.select(torch.from_numpy(rows)), tree.opacity[rows], camera, self._antialiased
            )
            image = render_rgb(g, camera, backend=self._backend, antialiased=False, workspace=self._space)
            yield Shown(image, len(rows), pages)
