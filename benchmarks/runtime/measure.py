"""Frames of a walk against the full model, and curves of that over splats drawn and bytes fetched."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from sagesplat.adapt.fidelity import PROMISED_SHARE
from sagesplat.metrics.image import means_by_label, ssim_map
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED

COUNTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)  # of the full model's splats, at which methods meet
SIZES = (0.1, 0.2, 0.4, 0.8, 1.5, 3.0)  # of our bytes of the full model: others take several times as many
RATES = (2, 10, 50)  # Mbit/s
FIDELITY = 0.9  # that a first view waits for


class Shown(NamedTuple):
    """What a method draws in a frame at one setting of its knob."""

    image: np.ndarray  # float32 [H, W, 3] in [0, 1]; may be overwritten by the next one
    # splats that are selected, in sight or not: what a viewer's budget counts
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]
    needed: np.ndarray  # bool [P], pieces of its files that have to be there


class Method(Protocol):
    """One way to choose what is drawn."""

    name: str
    settings: Sequence[float]  # J, of its knob
    piece_bytes: np.ndarray  # int64 [P], of what is fetched as one, encoded
    index_bytes: int  # that come before anything else
    targets: Sequence[float]  # of fidelity by category, of the last settings; none: not a promise

    def shown(self, frame: int, camera: Camera) -> Iterator[Shown]:
        """What is drawn at each setting."""
        ...


@dataclass(frozen=True, eq=False)
class Walked:
    """A method's walk: F frames at J settings."""

    name: str
    settings: tuple[float, ...]
    targets: tuple[float, ...]  # of the last settings
    whole: np.ndarray  # [F, J], SSIM against the full model, of the whole image
    by_category: np.ndarray  # [F, J, L]; NaN: less than PROMISED_SHARE of the pixels
    count: np.ndarray  # [F, J], splats
    nbytes: np.ndarray  # [F, J], fetched up to this frame

    def curve(self, over: str) -> tuple[np.ndarray, np.ndarray]:
        """Splats (mean) or bytes (by the end), ascending, and fidelity: mean, 5th percentile, lowest [3, n].

        Only of settings that no other one is better than, in the mean, with less.
        """
        x = self.count.mean(0) if over == "count" else self.nbytes[-1]
        lowest = np.fmin.reduce(self.by_category, axis=2)
        y = np.stack([self.whole.mean(0), np.quantile(self.whole, 0.05, axis=0), np.nanmean(lowest, axis=0)])
        order = np.lexsort([-y[0], x])
        best = np.maximum.accumulate(y[0, order])
        rows = order[np.concatenate([[True], best[1:] > best[:-1]])]
        return x[rows].astype(np.float64), y[:, rows]

    def at(self, over: str, at: np.ndarray) -> np.ndarray:
        """Those three [3, len(at)] at so many splats or bytes, along their logarithm.

        NaN where a method cannot do with so little; what it reaches with all where there is more than that.
        """
        x, y = self.curve(over)
        return np.stack([np.interp(np.log(at), np.log(x), row, left=np.nan) for row in y])

    def kept(self) -> list[dict[str, float]]:
        """What each target came to."""
        first, rows = len(self.settings) - len(self.targets), []
        for j, target in enumerate(self.targets, first):
            of_category = self.by_category[:, j]
            seen = np.isfinite(of_category)
            by_label = [(of_category[seen[:, i], i] >= target).mean() for i in np.flatnonzero(seen.any(0))]
            rows.append(
                {
                    "target": target,
                    "kept": float((of_category[seen] >= target).mean()),
                    "kept_lowest": float(min(by_label)),
                    "whole": float(self.whole[:, j].mean()),
                    "count": float(self.count[:, j].mean()),
                    "first_bytes": float(self.nbytes[0, j]),
                    "bytes": float(self.nbytes[-1, j]),
                }
            )
        return rows

    def first_bytes(self) -> float:
        """Fewest bytes with which the first view reaches FIDELITY; inf: it never does."""
        enough = self.nbytes[0][self.whole[0] >= FIDELITY]
        return float(enough.min(initial=np.inf))


def walk(methods: Sequence[Method], job: Job, cameras: Sequence[Camera]) -> list[Walked]:
    """Measure every frame of every method at every setting, against the run's full model."""
    references = job.references
    ids, labels = job.cells.ids, job.cells.labels
    tables = [np.zeros((3, len(cameras), len(method.settings))) for method in methods]
    names = np.setdiff1d(labels, [UNLABELLED])  # which has no promise
    of_categories = [np.full((*table.shape[1:], len(names)), np.nan) for table in tables]
    fetched = [np.zeros((len(method.settings), len(method.piece_bytes)), bool) for method in methods]
    for frame, camera in enumerate(cameras):
        at = references.at(camera)
        known = at.label_ids >= ids[0]
        label_ids = np.where(known, labels[np.searchsorted(ids, np.where(known, at.label_ids, ids[0]))], -1)
        for method, table, own, have in zip(methods, tables, of_categories, fetched, strict=True):
            for j, shown in enumerate(method.shown(frame, camera)):
                have[j] |= shown.needed
                sent = method.index_bytes + int(method.piece_bytes[have[j]].sum())
                whole, own[frame, j] = fidelity(shown.image, at.image, label_ids, names)
                table[:, frame, j] = whole, shown.count, sent
    return [
        Walked(method.name, tuple(method.settings), tuple(method.targets), table[0], own, *table[1:])
        for method, table, own in zip(methods, tables, of_categories, strict=True)
    ]


def fidelity(
    image: np.ndarray, full: np.ndarray, label_ids: np.ndarray, names: np.ndarray
) -> tuple[float, np.ndarray]:
    """SSIM of the whole image, and of each category; NaN: one that covers too little."""
    quality = ssim_map(image, full)
    means = means_by_label(quality, label_ids)
    least = PROMISED_SHARE * label_ids.size
    found = [means.get(label, (np.nan, 0)) for label in names.tolist()]
    return float(quality.mean()), np.array([mean if n >= least else np.nan for mean, n in found])


def summary(found: Sequence[Walked], count: int, nbytes: int) -> dict[str, Any]:
    """Every method at shares of `count` splats and of `nbytes`, and its first view."""
    counts, sizes = np.array(COUNTS) * count, np.array(SIZES) * nbytes
    return {
        "counts": counts.tolist(),
        "bytes": sizes.tolist(),
        "methods": {
            one.name: {
                "at_counts": one.at("count", counts).T.tolist(),
                "at_bytes": one.at("bytes", sizes).T.tolist(),
                "first_mb": one.first_bytes() / 1e6,
                "first_s": [8e-6 * one.first_bytes() / rate for rate in RATES],
                "finest": float(one.whole.mean(0).max()),
                "asked": one.kept(),
                "curve": {
                    "settings": list(one.settings),
                    "count": one.count.mean(0).tolist(),
                    "bytes": one.nbytes[-1].tolist(),
                    "mean": one.whole.mean(0).tolist(),
                    "p5": np.quantile(one.whole, 0.05, axis=0).tolist(),
                    "lowest": np.nanmean(np.fmin.reduce(one.by_category, axis=2), axis=0).tolist(),
                },
            }
            for one in found
        },
    }


def lines(result: dict[str, Any]) -> list[str]:
    """Tables for people: mean, 5th percentile and lowest category at equal splats, and at equal bytes."""
    out, methods = [], result["methods"]
    for key, head in (
        ("at_counts", [f"{n:,.0f} splats" for n in result["counts"]]),
        ("at_bytes", [f"{n / 1e6:.2f} MB" for n in result["bytes"]]),
    ):
        out.append("| method | " + " | ".join(head) + " |")
        out.append("|---" * (len(head) + 1) + "|")
        for name, row in methods.items():
            cells = ["–" if np.isnan(three[0]) else " ".join(f"{v:.3f}" for v in three) for three in row[key]]
            out.append(f"| {name} | " + " | ".join(cells) + " |")
        out.append("")
    rates = " | ".join(f"s at {rate} Mbit/s" for rate in RATES)
    out.append(f"| method | first view at {FIDELITY:g}, MB | {rates} | finest |")
    out.append("|---" * (len(RATES) + 3) + "|")
    for name, row in methods.items():
        seconds = " | ".join(f"{s:.2f}" for s in row["first_s"])
        out.append(f"| {name} | {row['first_mb']:.3f} | {seconds} | {row['finest']:.4f} |")
    asked = [(name, one) for name, row in methods.items() for one in row["asked"]]
    if asked:
        out += [
            "",
            "| asked | method | kept | lowest | whole | splats | first MB | visit MB |",
            "|---" * 8 + "|",
        ]
    for name, one in sorted(asked, key=lambda of: of[1]["target"]):
        shares = " | ".join(f"{one[key]:.3f}" for key in ("kept", "kept_lowest", "whole"))
        sizes = " | ".join(f"{one[key] / 1e6:.3f}" for key in ("first_bytes", "bytes"))
        out.append(f"| {one['target']:g} | {name} | {shares} | {one['count']:,.0f} | {sizes} |")
    return out
