"""Splat files between sagesplat and PlayCanvas's splat-transform, both ways: errors in steps of each format.

Each scene is written as a PLY, which splat-transform converts to each of its formats; sagesplat reads these.
Then sagesplat writes each of its own, which splat-transform converts to PLY. Rows come back in another order:
each is compared with the most similar one of the nearest sixteen. An error of 1 is one step of the format's
quantisation at that value. The palette of a SOG's harmonics has no step: its error is relative to their
standard deviation (root mean squares).
"""

import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import KDTree

from sagesplat.core.errors import BackendUnavailable
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.lod_meta_write import write_lod_meta
from sagesplat.formats.ply import write_ply
from sagesplat.formats.sog_write import write_sog
from sagesplat.formats.splats import read_splat
from sagesplat.formats.spz import write_spz
from tests.fuzz.readers.foreign_splats import dotsplat, put_sog, sog

PACKAGE = "@playcanvas/splat-transform@3.7"
ATTRIBUTES = ("positions", "rotations", "scales", "opacities", "colours", "harmonics")
NEIGHBOURS = 16
ALIKE = {"positions": 1e-4, "rotations": 0.01, "scales": 0.02, "opacities": 1 / 255, "colours": 0.02}
TURN = 2 * 3**0.5  # products of components per component, where each of three is off by one step
Steps = dict[str, np.ndarray | float]


@dataclass(frozen=True)
class Transform:
    """splat-transform as a command."""

    command: tuple[str, ...]

    def __call__(self, *arguments: str | Path) -> None:
        """Run it; BackendUnavailable with what it said if it fails."""
        call = [*self.command, "-q", "-w", "-g", "cpu", *map(str, arguments)]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise BackendUnavailable(f"{' '.join(call)} failed: {' '.join(said)}")


def found(path: Path | None) -> Transform:
    """splat-transform 3, at a path or by npx; BackendUnavailable where there is none."""
    if path is None and shutil.which("npx") is None:
        raise BackendUnavailable(
            "no splat-transform: install Node 22 or newer, or name one (--splat-transform)"
        )
    command = (str(path),) if path else ("npx", "--yes", PACKAGE)
    try:
        said = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise BackendUnavailable(f"{path}: cannot be run ({error.strerror}); name splat-transform") from None
    text = said.stdout + said.stderr
    if "v3." not in text:
        raise BackendUnavailable(
            f"{command[0]}: {text.strip()[:100]!r} is not splat-transform 3; it needs Node 22"
        )
    return Transform(command)


def labelled(count: int, degree: int, seed: int = 0) -> Gaussians:
    """Random Gaussians of three categories, within what all formats hold."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    shN = 0.2 * normal(count, (degree + 1) ** 2 - 1, 3)
    labels = torch.randint(-1, 3, (count,), generator=rng).to(torch.int16)
    colours = normal(count, 1, 3).clamp(-3, 3)
    scales = (normal(count, 3) - 4).clamp(-9, 5)
    return Gaussians(
        3 * normal(count, 3),
        normal(count, 4),
        scales,
        2 * normal(count),
        colours,
        shN.clamp(-0.9, 0.9),
        labels,
    )


def measure(g: Gaussians, transform: Transform, folder: Path) -> dict[str, dict[str, float]]:
    """Errors of each pair of formats in steps, by what was done ("theirs x.sog": they wrote it)."""
    write_ply(folder / "base.ply", g)
    result = {}
    theirs: dict[str, tuple[tuple[str, ...], Callable[[Gaussians, Gaussians], Steps]]] = {
        "x.ply": ((), _exact),
        "x.compressed.ply": ((), _chunked),
        "three.spz": (("--spz-version", "3"), _spz(12)),
        "four.spz": (("--spz-version", "4"), _spz(12)),
        "x.sog": ((), _sog),
        "sog/meta.json": ((), _sog),
        "lod/lod-meta.json": (("-l", "0"), _sog),
        "x.glb": ((), _exact),
    }
    for name, (options, steps) in theirs.items():
        (folder / name).parent.mkdir(exist_ok=True)
        before, after = (options, ()) if options[:1] == ("-l",) else ((), options)
        transform(folder / "base.ply", *before, folder / name, *after)
        read = read_splat(folder / name, spz_axes="rdf").gaussians
        result[f"theirs {name}"] = errors(read, g, steps)
    ours: dict[str, tuple[Callable[[Path], object], Callable[[Gaussians, Gaussians], Steps]]] = {
        "y.ply": (lambda path: write_ply(path, g, {0: "a"}), _exact),
        "three-y.spz": (lambda path: write_spz(path, g, frame="rdf", fractional_bits=12), _spz(12)),
        "four-y.spz": (
            lambda path: write_spz(path, g, frame="rdf", fractional_bits=12, version=4, names={0: "a"}),
            _spz(12),
        ),
        "y.sog": (lambda path: write_sog(path, g), _sog),
        "sog-y/meta.json": (lambda path: write_sog(path, g), _sog),
        "lod-y/lod-meta.json": (lambda path: write_lod_meta(path.parent, [g], leaf=20_000), _sog),
    }
    for name, (write, steps) in ours.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write(folder / name)
        transform(folder / name, folder / "back.ply")
        result[f"ours {name.replace('-y', '').replace('y.', 'x.')}"] = errors(
            read_splat(folder / "back.ply").gaussians, g, steps
        )
    return result


def readers_agree(transform: Transform, folder: Path) -> dict[str, dict[str, float]]:
    """Of formats that neither writes, the difference of what both read, in steps of float32."""
    (folder / "z.splat").write_bytes(dotsplat(5000))
    paths = {"z.splat": folder / "z.splat"}
    for bases in (0, 3, 8, 15):
        meta, images = sog(5000, bases, version=1)
        paths[f"SOG 1, {bases} harmonics"] = put_sog(folder / f"first-{bases}", meta, images)
    result = {}
    for name, path in paths.items():
        transform(path, folder / "back.ply")
        ours, theirs = read_splat(path).gaussians, read_splat(folder / "back.ply").gaussians
        result[f"both read {name}"] = errors(ours, theirs, _dotsplat if "splat" in name else _exact)
    return result


def errors(read: Gaussians, g: Gaussians, steps: Callable[[Gaussians, Gaussians], Steps]) -> dict[str, float]:
    """The largest error of each attribute in steps, and how many rows are missing."""
    g = g.select(torch.from_numpy(_matched(read, g)))
    ours, theirs = _values(read), _values(g)
    sizes = steps(read, g)
    result: dict[str, float] = {"rows": len(read)}
    for name in ATTRIBUTES:
        if ours[name].size and f"{name} rms" in sizes:
            error = np.sqrt(np.square(ours[name] - theirs[name]).mean())
            result[f"{name} rms"] = float(error / theirs[name].std())
        elif ours[name].size:
            worst = np.abs(ours[name] - theirs[name]) / sizes[name]
            result[name] = float(worst.max())
    return result


def _matched(read: Gaussians, g: Gaussians) -> np.ndarray:
    """For each row that was read, the most similar row of `g`: the same row, or one of the nearest ones."""
    k = min(NEIGHBOURS, len(g))
    rows = KDTree(g.means.numpy()).query(read.means.numpy(), k=k)[1].reshape(len(read), k)
    if len(read) == len(g):
        rows = np.concatenate([np.arange(len(g))[:, None], rows], 1)
    ours, theirs = _values(read), _values(g)
    cost = np.zeros(rows.shape)
    for name, step in ALIKE.items():
        scale = 1 + np.abs(ours["positions"]).max(1) if name == "positions" else np.ones(len(read))
        values, originals = ours[name].reshape(len(read), -1), theirs[name].reshape(len(g), -1)
        for column in range(rows.shape[1]):
            error = np.abs(values - originals[rows[:, column]]).max(1) / scale / step
            cost[:, column] += error.clip(0, 10)  # one value that is far off does not make another row
    return rows[np.arange(len(rows)), cost.argmin(1)]


def _values(g: Gaussians) -> dict[str, np.ndarray]:
    """Attributes by name; rotations as products of quaternions' components, which have no sign."""
    quats = torch.nn.functional.normalize(g.quats.double(), dim=1).numpy()
    return {
        "positions": g.means.double().numpy(),
        "rotations": quats[:, :, None] * quats[:, None],
        "scales": g.log_scales.double().numpy(),
        "opacities": torch.sigmoid(g.logit_opacities.double()).numpy(),
        "colours": g.sh0[:, 0].double().numpy(),
        "harmonics": g.shN.double().numpy(),
    }


def _exact(read: Gaussians, g: Gaussians) -> Steps:
    """Of float32, and of the logarithms and exponentials between."""
    reach = float(g.means.abs().max())
    return {
        "positions": 1e-6 * reach, "rotations": 1e-6, "scales": 1e-5, "opacities": 1e-6, "colours": 1e-5,
        "harmonics": 1e-5,
    }  # fmt: skip


def _dotsplat(read: Gaussians, g: Gaussians) -> Steps:
    return _exact(read, g) | {"rotations": 3 / 128, "opacities": 1 / 255 / 4}  # theirs divides by 127.5


def _chunked(read: Gaussians, g: Gaussians) -> Steps:
    """Of compressed PLY: shares of what each 256 rows span, as read, which is what they spanned."""

    def span(values: np.ndarray) -> np.ndarray:
        parts = [values[i : i + 256] for i in range(0, len(values), 256)]
        return np.concatenate([np.repeat(np.ptp(p, axis=0, keepdims=True), len(p), 0) for p in parts]) + 1e-5

    bits = np.array([2047, 1023, 2047])
    return {
        "positions": span(read.means.numpy()) / bits,
        "rotations": TURN * 2**0.5 / 1023,
        "scales": span(read.log_scales.numpy()) / bits,
        "opacities": 1 / 255,
        "colours": span(read.sh0[:, 0].numpy()) / 255,
        "harmonics": 8 / 256,
    }


def _spz(bits: int) -> Callable[[Gaussians, Gaussians], Steps]:
    def steps(read: Gaussians, g: Gaussians) -> Steps:
        harmonics = np.full((g.shN.shape[1], 1), 1 / 8)
        harmonics[:3] = 1 / 16
        outside = np.abs(g.shN.numpy()).clip(1) - 1  # what clipping costs, and of what follows
        far = (np.abs(g.sh0[:, 0].numpy()).clip(3.33) - 3.33) * 40
        scales = g.log_scales.numpy()
        beyond = 16 * np.maximum(scales - 5.93, -10 - scales).clip(0)
        return {
            "positions": 2.0**-bits, "rotations": TURN / (511 * 2**0.5), "scales": (1 + beyond) / 16,
            "opacities": 1 / 255, "colours": (1 + far) / 38.25, "harmonics": harmonics + outside,
        }  # fmt: skip

    return steps


def _sog(read: Gaussians, g: Gaussians) -> Steps:
    """Of SOG: 16 bits of a logarithm; the gap between values of a codebook, or beyond its ends."""

    def gaps(values: np.ndarray, found: np.ndarray) -> np.ndarray:
        book = np.unique(found)
        right = np.searchsorted(book, values).clip(1, len(book) - 1)
        beyond = np.maximum(book[0] - values, values - book[-1]).clip(0)
        return book[right] - book[right - 1] + beyond + 1e-5

    means = g.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    # splat-transform's images lose the colour of pixels whose alpha is 0: of opacities below half a step
    unseen = np.where(torch.sigmoid(read.logit_opacities).numpy() < 0.5 / 255, np.inf, 0)
    return {
        "positions": np.ptp(logs, axis=0) / 65535 * (1 + np.abs(means)) + 1e-6,
        "rotations": TURN * 2**0.5 / 255,
        "scales": gaps(g.log_scales.numpy(), read.log_scales.numpy()),
        "opacities": 1 / 255 + 1e-6,
        "colours": gaps(g.sh0[:, 0].numpy(), read.sh0[:, 0].numpy()) + unseen[:, None],
        "harmonics rms": 1.0,
    }


def run(
    paths: Sequence[Path], transform: Transform, folder: Path, count: int
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors of all pairs, of splats at `paths` and of random ones, by scene."""
    scenes = {f"random, degree {degree}": labelled(count, degree) for degree in (0, 1, 2, 3)}
    for path in paths:
        name, _, lod = str(path).partition("@")
        g = read_splat(Path(name), int(lod or 0)).gaussians
        scenes[str(path.name)] = replace(g, logit_opacities=g.logit_opacities.clamp(-12, 12))
    result = {"": readers_agree(transform, folder)}
    return result | {name: measure(g, transform, folder) for name, g in scenes.items()}


def verdict(result: dict[str, dict[str, dict[str, float]]]) -> dict[str, float]:
    """The largest error in steps of each attribute, over all scenes and pairs."""
    rows = [errors for pairs in result.values() for errors in pairs.values()]
    names = [*ATTRIBUTES, "harmonics rms"]
    return {name: max((row[name] for row in rows if name in row), default=0.0) for name in names}
