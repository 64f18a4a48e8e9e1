"""Structure from motion by COLMAP, as a script in its own process: `python -P _sfm.py FOLDER`.

It imports nothing from the package and nothing that imports Pillow: pycolmap and Pillow in one process have
corrupted its heap. The request is FOLDER/request.json. Progress, errors and the result go to standard output
as lines of JSON, COLMAP's log to standard error. The process exits at the end of standard input, that is,
when its parent exits.
"""

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

FEW_FEATURES = 50  # registration needs 30 correspondences, which fewer features rarely give
MIN_INLIERS = 15  # of a matched pair of photos; COLMAP's default
OVERLAP = 10  # next photos that each photo is matched with in sequential matching
KEYFRAMES = 30  # evenly spaced photos that sequential matching matches exhaustively, to close loops
SEED = 0  # of RANSAC and of the mapping
PAIRS_AT_A_TIME = 200

Send = Callable[[dict[str, Any]], None]
OnProgress = Callable[[int, int], None]


def sequential_pairs(count: int) -> list[tuple[int, int]]:
    """Pairs of neighbours up to OVERLAP, at powers of two (COLMAP's quadratic overlap), and of keyframes."""
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(count.bit_length()))})
    pairs = {(i, i + step) for step in steps for i in range(count - step)}
    keys = np.unique(np.linspace(0, count - 1, min(KEYFRAMES, count)).astype(int)).tolist()
    return sorted(pairs | {(a, b) for a in keys for b in keys if a < b})


def upright(rotations: np.ndarray) -> np.ndarray:
    """The world rotation [3, 3] that maps gravity to +y, from the cameras' w2c rotations [N, 3, 3].

    Most photos are taken without roll. So gravity is estimated as the direction most nearly perpendicular to
    all cameras' x axes. If these are nearly parallel, it is the mean of the cameras' y axes. The result is
    the identity if that mean vanishes as well.
    """
    x, down = rotations[:, 0], rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    if values[1] > 0.05 and abs(vectors[:, 0] @ down) > 0.2:
        down = vectors[:, 0] * np.sign(vectors[:, 0] @ down)
    length = np.linalg.norm(down)
    if length < 0.2:
        return np.eye(3)
    down = down / length
    ahead = np.eye(3)[2] - down[2] * down  # changes z as little as possible
    if np.linalg.norm(ahead) < 1e-3:
        ahead = np.eye(3)[0] - down[0] * down
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(down, ahead), down, ahead])


class Stages:
    """The stages of a request, one method each, and the folder that they work in."""

    def __init__(self, folder: Path, request: dict[str, Any]):
        self.folder, self.request = folder, request
        self.photos, self.database = folder / "photos", folder / "database.db"
        self.names: list[str] = [name for group in request["cameras"] for name in group]
        self.order: list[str] = request["order"]
        self.device = pycolmap.Device(request["device"])
        self.threads: int = request["threads"]
        self.reader = pycolmap.ImageReaderOptions(camera_model=request["model"])
        if request.get("masks"):
            self.reader.mask_path = folder / "masks"

    def features(self, on_progress: OnProgress) -> None:
        """Add photos and cameras to the database; extract SIFT features of photos without any."""
        with pycolmap.Database.open(self.database) as database:
            known = {image.name for image in database.read_all_images()}
        for group in self.request["cameras"]:
            if not known.issuperset(group):
                pycolmap.import_images(
                    self.database, self.photos, pycolmap.CameraMode.SINGLE, group, self.reader
                )
        with pycolmap.Database.open(self.database) as database:
            images = database.read_all_images()
            done = {image.name for image in images if database.exists_descriptors(image.image_id)}
        left = [name for name in self.order if name not in done]
        options = pycolmap.FeatureExtractionOptions(
            max_image_size=self.request["max_size"], num_threads=self.threads
        )
        batch = 2 * max(self.threads, os.cpu_count() or 1)
        for start in range(0, len(left), batch):
            on_progress(len(self.order) - len(left) + start, len(self.order))
            names = left[start : start + batch]
            pycolmap.extract_features(
                self.database,
                self.photos,
                names,
                pycolmap.CameraMode.PER_IMAGE,  # no effect: the cameras are in the database already
                self.reader,
                options,
                self.device,
            )
        on_progress(len(self.order), len(self.order))

    def matches(self, on_progress: OnProgress) -> None:
        """Match and verify the pairs that have not been matched yet."""
        count = len(self.order)
        sequential = self.request["matching"] == "sequential"
        wanted = sequential_pairs(count) if sequential else [*combinations(range(count), 2)]
        with pycolmap.Database.open(self.database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            left = [
                pair
                for pair in wanted
                if not database.exists_two_view_geometry(*(ids[self.order[i]] for i in pair))
            ]
        options = pycolmap.FeatureMatchingOptions(num_threads=self.threads)
        verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_INLIERS)
        verification.ransac.random_seed = SEED
        listed = self.folder / "pairs.txt"
        for start in range(0, len(left), PAIRS_AT_A_TIME):
            on_progress(len(wanted) - len(left) + start, len(wanted))
            pairs = left[start : start + PAIRS_AT_A_TIME]
            listed.write_text("".join(f"{self.order[i]} {self.order[j]}\n" for i, j in pairs))
            pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
            pycolmap.match_image_pairs(self.database, options, pairing, verification, self.device)
        on_progress(len(wanted), len(wanted))

    def mapping(self, on_progress: OnProgress) -> None:
        """Incremental mapping: write the largest model, upright, to model/ and a report to models.json."""
        if (self.folder / "models.json").is_file():
            return
        total, done = len(self.order), 0

        def registered(count: int) -> None:
            nonlocal done
            done = min(done + count, total)
            on_progress(done, total)

        on_progress(0, total)
        scratch = _empty(self.folder / "models")
        models = pycolmap.incremental_mapping(
            self.database,
            self.photos,
            scratch,
            self._mapping_options(),
            initial_image_pair_callback=lambda: registered(2),
            next_image_callback=lambda: registered(1),
        )
        largest_first = sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
        if largest_first:
            best = largest_first[0]
            rotations = np.stack(
                [best.image(i).cam_from_world().rotation.matrix() for i in best.reg_image_ids()]
            )
            turn = pycolmap.Rotation3d(upright(rotations))
            best.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
            best.write(_empty(self.folder / "model"))
        shutil.rmtree(scratch)
        result = self._result(largest_first)
        _replace(self.folder / "models.json", result)
        on_progress(total, total)

    def _mapping_options(self) -> Any:
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size = 3
        options.num_threads = self.threads
        options.random_seed = options.mapper.random_seed = SEED
        options.triangulation.random_seed = SEED
        options.ba_refine_principal_point = self.request["refine_principal_point"]
        return options

    def _result(self, models: list[Any]) -> dict[str, Any]:
        """Registered photos, statistics of the largest model, and the reason for each unregistered photo."""
        members = [{model.image(i).name for i in model.reg_image_ids()} for model in models]
        registered = sorted(members[0]) if members else []
        left = [name for name in self.order if name not in registered]
        return {
            "registered": registered,
            "reasons": self._reasons(left, members[1:]),
            "num_points": models[0].num_points3D() if models else 0,
            "reprojection_error": models[0].compute_mean_reprojection_error() if models else 0.0,
        }

    def _reasons(self, names: list[str], smaller: list[set[str]]) -> dict[str, str]:
        """Photo -> why it is not in the largest model."""
        with pycolmap.Database.open(self.database) as database:
            pairs, inliers = database.read_two_view_geometry_num_inliers()
            kept = [pair for pair, count in zip(pairs, inliers, strict=True) if count >= MIN_INLIERS]
            matched = {i for pair in kept for i in pycolmap.pair_id_to_image_pair(pair)}
            ids = {image.name: image.image_id for image in database.read_all_images()}
            reasons = {}
            for name in names:
                image_id = ids[name]
                model = next((members for members in smaller if name in members), None)
                if model is not None:
                    reasons[name] = f"in a smaller separate model ({len(model)} photos)"
                elif database.num_keypoints_for_image(image_id) < FEW_FEATURES:
                    reasons[name] = "too few features"
                elif image_id not in matched:
                    reasons[name] = "no match with enough inliers"
                else:
                    reasons[name] = "not registered: too few 2D-3D correspondences"
        return reasons

    def undistortion(self, on_progress: OnProgress) -> None:
        """Write undistorted photos and their pinhole model to undistorted/, under the photos' own names."""
        target, total = _empty(self.folder / "undistorted"), len(self.order)
        on_progress(0, total)
        options = pycolmap.UndistortCameraOptions(max_image_size=self.request["max_size"])
        pycolmap.undistort_images(
            target,
            self.folder / "model",
            self.photos,
            undistort_options=options,
            jpeg_quality=95,
            num_threads=self.threads,
        )
        model = pycolmap.Reconstruction(target / "sparse")
        shutil.rmtree(target / "sparse")
        (target / "images").rename(target / "hashed")
        for image in model.images.values():
            final = self.request["names"][image.name]
            (target / "images" / final).parent.mkdir(parents=True, exist_ok=True)
            (target / "hashed" / image.name).rename(target / "images" / final)
            image.name = final
        (target / "sparse" / "0").mkdir(parents=True)
        model.write(target / "sparse" / "0")
        on_progress(total, total)


def _empty(folder: Path) -> Path:
    """The folder, emptied or created."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _replace(path: Path, content: dict[str, Any]) -> None:
    """Replace a JSON file atomically."""
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(content))
    temporary.replace(path)


def _end_with_parent() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock would be held when the interpreter ends
        pass
    os._exit(1)


def run(folder: Path, send: Send) -> None:
    """Run all stages of the request in `folder`; undistortion only if enough photos are registered."""
    request = json.loads((folder / "request.json").read_text(encoding="utf-8"))
    if request["device"] == "cuda" and not pycolmap.has_cuda:
        send({"unavailable": "this pycolmap has no CUDA; install pycolmap-cuda12 or take device cpu"})
        return
    pycolmap.set_random_seed(SEED)
    stages, times = Stages(folder, request), folder / "seconds.json"
    seconds = json.loads(times.read_text()) if times.is_file() else {}  # of earlier, killed runs
    for name in ("features", "matches", "mapping", "undistortion"):
        started = time.perf_counter()
        getattr(stages, name)(
            lambda done, total, name=name: send({"stage": name, "done": done, "total": total})
        )
        seconds[name] = round(seconds.get(name, 0) + time.perf_counter() - started, 2)
        _replace(times, seconds)
        if name == "mapping" and len(_result(folder)["registered"]) < request["min_photos"]:
            break
    send({"result": _result(folder) | {"seconds": seconds}})


def _result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "models.json").read_text(encoding="utf-8"))


def main() -> None:
    """Run the request in the folder argv[1]; what COLMAP prints to standard output goes to the log."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def send(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    run(Path(sys.argv[1]), send)


if __name__ == "__main__":
    main()
