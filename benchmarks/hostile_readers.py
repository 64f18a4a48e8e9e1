"""The readers that `hostile.check` is for, each with valid files of a few hundred bytes."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.hostile import DEFLATE, MIB, Reader
from sagesplat.adapt.eq3 import read_models
from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.observe import Observations, read_observations
from sagesplat.adapt.plan import read_budget_plan, read_plans
from sagesplat.adapt.viewpoint import read_promises
from sagesplat.core.gaussians import Gaussians
from sagesplat.download.remote_zip import TAIL, RemoteZip
from sagesplat.formats.increments import read_increments, read_index, totals
from sagesplat.formats.levels import read_level, write_level, write_set
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.spz import decode_spz, encode_spz
from sagesplat.io.files import read_json
from sagesplat.scene.blocks import Blocks, read_blocks, write_blocks
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.nerfstudio import load_transforms
from sagesplat.scene.points import read_points
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View
from sagesplat.scene.stored import read_scene, write_scene
from sagesplat.segment.coco import read_panoptic
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import Taxonomy, read_mask, write_mask
from sagesplat.segment.onnx import read_classes
from sagesplat.segment.soft import read_soft, write_soft
from sagesplat.studies.sweep.file import read_sweep
from sagesplat.train.checkpoint import read_checkpoint, write_checkpoint
from sagesplat.train.state import initial_state

PHOTOS = ("a.png", "b.png", "c.png")
SETTINGS = json.dumps({"steps": 2})  # of the checkpoint
JSON = 64  # bytes of Python objects for a byte of JSON: {"a":1} takes 232
TEXT = 96  # the same of rows of words


def splats(count: int = 3, bases: int = 3) -> Gaussians:
    """A few Gaussians of two categories."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    labels = torch.tensor([2] * (count - 1) + [5], dtype=torch.int16)
    scales, opacities, shN = normal(count, 3) - 3, normal(count), 0.1 * normal(count, bases, 3)
    return Gaussians(normal(count, 3), normal(count, 4), scales, opacities, normal(count, 1, 3), shN, labels)


def _written(path: Path, write: Callable[[Path], Any]) -> bytes:
    """What a writer writes."""
    write(path)
    content = path.read_bytes()
    path.unlink()
    return content


def _file(name: str, read: Callable[[Path], Any]) -> Callable[[Path, bytes], Any]:
    """A reader of a path as one of content; `name` is the file's."""

    def reading(folder: Path, content: bytes) -> Any:
        (folder / name).write_bytes(content)
        return read(folder / name)

    return reading


def _json(*documents: Any) -> Callable[[Path], list[bytes]]:
    return lambda _: [json.dumps(document).encode() for document in documents]


def _photos(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in PHOTOS:
        Image.new("RGB", (16, 12), (9, 99, 9)).save(folder / name)


def _colmap(part: str, text: bool) -> Reader:
    """One file of a COLMAP workspace, whose others are sound."""
    name = f"{part}{'.txt' if text else '.bin'}"
    base = {"cameras": "PINHOLE", "images": "PINHOLE", "points3D": "OPENCV"}[part]

    def make(folder: Path) -> list[bytes]:
        _photos(folder / "images")
        (folder / "sparse").mkdir()
        params = (14.0, 14.0, 8.0, 6.0) + (0.01, 0.0, 0.0, 0.0) * (base == "OPENCV")
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 0, 3] = [0, 0.1, 0.2]
        uv = np.array([[8.0, 6.0], [3.0, 4.0]])
        images = [
            ModelImage(i + 1, PHOTOS[i], 1, pose, uv, np.array([0, 1 - i])) for i, pose in enumerate(poses)
        ]
        xyz, rgb = np.array([[0, 0, 4.0], [1, 0, 5]]), np.full((2, 3), 7, np.uint8)
        camera = ModelCamera(1, base, 16, 12, params)
        write_model(folder / "sparse", [camera], images, xyz, rgb, np.ones(2), text=text)
        return [(folder / "sparse" / name).read_bytes()]

    read = _file(f"sparse/{name}", lambda path: load_colmap(path.parents[1]))
    return Reader(f"colmap-{name.replace('.', '-')}", name[-4:], make, read, TEXT)


def _points(folder: Path) -> list[bytes]:
    head = "element vertex 2\n" + "".join(f"property {kind}\n" for kind in ("float x", "float y", "float z"))
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    table = np.zeros(2, [("xyz", ">f4", 3), ("rgb", "u1", 3)])
    return [
        f"ply\nformat ascii 1.0\n{head}0 1 2 3 4 5\n6 7 8 9 10 11\n".encode(),
        f"ply\nformat binary_big_endian 1.0\n{head}".encode() + table.tobytes(),
    ]


def _transforms(folder: Path) -> list[bytes]:
    _photos(folder / "images")
    (folder / "points.ply").write_bytes(_points(folder)[0])
    frames = []
    for i, name in enumerate(PHOTOS):
        matrix = np.eye(4)
        matrix[0, 3] = i
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    shared = {"w": 16, "h": 12, "fl_x": 14.0, "cx": 8.0, "k1": 0.01, "ply_file_path": "points.ply"}
    listed = {"train_filenames": [f"images/{n}" for n in PHOTOS]}
    return [
        json.dumps({**shared, "frames": frames}).encode(),
        json.dumps({**shared, **listed, "camera_angle_x": 1, "frames": frames}).encode(),
    ]


def _masks(folder: Path) -> list[bytes]:
    ids = np.array([[1, 2, -1], [2, 2, 1]], np.int16)
    small, large = Taxonomy({1: "sky", 2: "tree"}), Taxonomy({1: "sky", 2: "tree", 300: "car"})
    return [_written(folder / "m.png", lambda path, t=t: write_mask(path, ids, t)) for t in (small, large)]


def _read_panoptic(path: Path) -> None:
    read_panoptic(path.parent)


CURVE = {
    "label_id": 2,
    "level": 1,
    "d_range": [1, 9.5],
    "median": 0.8,
    "rmse": 0.01,
    "num_observations": 7,
    "status": "",
}
CHUNK = {"label_id": 2, "level": 1, "count": 3, "nbytes": 99, "gpu_bytes": 48, "sha256": "0" * 64}
CHOICE = {"label_id": 2, "level": 1, "predicted_ssim": 0.8, "distance": None, "count": 3, "status": ""}


def _models(folder: Path) -> list[bytes]:
    from sagesplat.adapt.eq3 import STATUSES, Eq3

    params = dict.fromkeys(Eq3._fields, 0.5)
    return _json({"models": [CURVE | {"params": params, "status": sorted(STATUSES)[0]}]})(folder)


def _promises(folder: Path) -> list[bytes]:
    from sagesplat.adapt.viewpoint import NUMBERS, STATUSES

    curve = json.loads(_models(folder)[0])["models"][0]
    entry = dict.fromkeys(NUMBERS, 0.5) | {"label_id": 2, "curves": [curve], "lengths": [1, 2, 0.5]}
    entry |= {"inputs": [[0.1] * 7, [0.2] * 7], "heldout_inputs": [False, True], "weights": [[0.1], [0.2]]}
    return _json({"promises": [entry | {"amplitudes": [0.1], "status": sorted(STATUSES)[0]}]})(folder)


def _plans(folder: Path) -> list[bytes]:
    from sagesplat.adapt.plan import STATUSES

    choices = [CHOICE | {"status": sorted(STATUSES)[0], "transfer_bytes": 9}]
    plan = {"target": 0.8, "view": None, "share": 0.9, "choices": choices}
    budget = plan | {"target": None, "budget": 1e6, "unit": "bytes", "fits": True}
    return _json({"targets": [0.8], "scene": [plan], "views": [plan | {"view": 1}], "budget": budget})(folder)


def _read_plans(path: Path) -> None:
    read_plans(path)
    read_budget_plan(path)


def _index(folder: Path) -> list[bytes]:
    content = encode_spz(splats())
    (folder / "sky-01.spz").write_bytes(content)
    chunk = CHUNK | {"uri": "sky-01.spz", "nbytes": len(content)}
    return _json({"format": "spz", "chunks": [chunk]}, {"format": "spz", "chunks": [chunk, chunk]})(folder)


def _read_index(path: Path) -> None:
    chunks = read_index(path.parent)
    totals(chunks, [2, 5], 3, "nbytes")
    if len(chunks) < 10:  # what many chunks hold is not bounded by their index
        read_increments(path.parent, chunks)


def _observations(folder: Path) -> list[bytes]:
    whole, number = np.array([1, 2], np.int32), np.array([0.5, np.nan], np.float32)
    table = Observations(whole, whole, whole, number, number, number, number, whole)
    return [_written(folder / "o.csv", table.write_csv)]


def _checkpoints(folder: Path) -> list[bytes]:
    state = initial_state(splats(), 0)
    state.queue, state.frozen = [1, 0], {2: 1}
    return [_written(folder / "c.npz", lambda path: write_checkpoint(path, state, SETTINGS))]


def _levels(folder: Path) -> list[bytes]:
    folder.mkdir(exist_ok=True)
    write_level(folder, 7, splats(), recovering=False, sh_degree=1)
    return [_written(folder / "000007.npz", lambda path: None)]


def _nested(folder: Path) -> list[bytes]:
    sizes = {2: [1, 2], 5: [0, 1]}
    return [_written(folder / "n.npz", lambda path: write_set(path, splats(), 7, sizes, place=np.ones(3)))]


def _read_nested(path: Path) -> None:
    ladder = read_prefixes(path)
    ladder.load(ladder.levels[-1])


def _soft(folder: Path) -> list[bytes]:
    share = np.full((2, 8, 8), 0.5, np.float32)
    return [
        _written(folder / "s.npz", lambda path: write_soft(path, share, np.array([1, 2], np.int16), (8, 8)))
    ]


def _lifted(folder: Path) -> list[bytes]:
    table = LiftedLabels(np.zeros(4, np.int16), np.ones(4, np.int32), np.ones(4, np.int32))
    return [_written(folder / "l.npz", table.write)]


def _stored(folder: Path) -> list[bytes]:
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 8, 6)
    lens = Lens("OPENCV", (4.0, 4.0, 4.0, 3.0, 0.1, 0.0, 0.0, 0.0), 8, 6)
    views = tuple(View(name, camera, Path(f"/p/{name}"), lens) for name in PHOTOS)
    rows, xyz = np.arange(3), np.zeros((3, 3), np.float32)
    points = Points(xyz, xyz.astype(np.uint8), rows, rows.astype(np.int32), xyz[:, :2])
    return [_written(folder / "s.npz", lambda path: write_scene(path, Scene("s", folder, views, points)))]


def _partition(folder: Path) -> list[bytes]:
    low, high = np.array([[-np.inf, 0], [1, -np.inf]]), np.array([[1, np.inf], [np.inf, 2.5]])
    blocks = Blocks(np.eye(3)[:2], low, high, 0.5)
    return [_written(folder / "b.json", lambda path: write_blocks(path, blocks, views=[3, 4]))]


SWEEP = """targets = [0.4, 0.3]
seeds = [0, 5]
settings.ladder = "snapshots"
settings.train = { max_steps = 60, level_every = 20 }
scenes.plot = "demo"
variants.track = {}
variants.projection.lift.votes = "projection"
"""


def _archive(folder: Path) -> list[bytes]:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("images/a.txt", "abc" * 30, zipfile.ZIP_DEFLATED)
        archive.writestr("b.txt", "abc")
    return [file.getvalue()]


class _Local(RemoteZip):
    """An archive that is here already."""

    def __init__(self, content: bytes):
        self.all = content
        self.url, self.size, self._position = "zip", len(content), 0
        self._tail = content[-TAIL:]

    def _blocks(self, start: int, stop: int):  # type: ignore[no-untyped-def]
        yield from (self.all[at : min(stop, at + 50)] for at in range(start, stop, 50))


def _read_archive(folder: Path, content: bytes) -> None:
    archive = _Local(content)
    for member in archive.members()[:5]:
        for _ in archive.content(member):
            pass


def _spz(folder: Path) -> list[bytes]:
    return [encode_spz(splats()), encode_spz(splats(bases=0), coarse=True)]


PANOPTIC = {
    "categories": [{"id": 1, "name": "sky"}],
    "annotations": [{"file_name": "a.png", "segments_info": [{"id": 7, "category_id": 1}]}],
}
CLASSES = {"classes": ["sky", "x"], "coco_panoptic": {"sky": 187, "x": None}, "mean": [0.4, 0.5, 0.6]}
NAMES = {"unlabelled": 255, "labels": {"184": "tree-merged", "7": "sky"}}

READERS = (
    *(_colmap(part, text) for part in ("cameras", "images", "points3D") for text in (False, True)),
    Reader("ply-points", ".ply", _points, _file("p.ply", read_points), TEXT),
    Reader(
        "ply-splats",
        ".ply",
        lambda folder: [_written(folder / "g.ply", lambda path: write_ply(path, splats(), {2: "sky"}))],
        _file("g.ply", read_ply),
        32,
    ),
    # What was unpacked, as floats and as torch has it
    Reader("spz", ".spz", _spz, lambda folder, content: decode_spz(content), 12 * DEFLATE),
    # Grey values of one bit each, as int32
    Reader(
        "mask",
        ".png",
        _masks,
        _file("m.png", lambda path: read_mask(path, Taxonomy({1: "sky", 2: "tree"}))),
        8 * 16 * DEFLATE,
    ),
    Reader("labels", ".json", _json(NAMES), _file("labels.json", Taxonomy.read), JSON),
    Reader("panoptic", ".json", _json(PANOPTIC), _file("p.json", _read_panoptic), JSON),
    # Without a PLY file there are 100,000 random points.
    Reader("transforms", ".json", _transforms, _file("transforms.json", load_transforms), TEXT, 64 * MIB),
    Reader("json", ".json", _json({"a": [1, "x", None, 1.5]}, [[], {}]), _file("m.json", read_json), JSON),
    Reader("chunks", ".json", _index, _file("index.json", _read_index), TEXT),
    Reader("plans", ".json", _plans, _file("plan.json", _read_plans), JSON),
    Reader("models", ".json", _models, _file("models.json", read_models), JSON),
    Reader("promises", ".json", _promises, _file("promises.json", read_promises), JSON),
    Reader("observations", ".csv", _observations, _file("o.csv", read_observations), TEXT),
    Reader("checkpoint", ".npz", _checkpoints, _file("c.npz", lambda p: read_checkpoint(p, SETTINGS)), 16),
    Reader("level", ".npz", _levels, _file("000007.npz", read_level), 32),
    Reader("nested", ".npz", _nested, _file("n.npz", _read_nested), 48),
    Reader("soft", ".npz", _soft, _file("s.npz", read_soft), 8 * DEFLATE),
    Reader("lifted", ".npz", _lifted, _file("l.npz", lambda path: LiftedLabels.read(path, 4)), 16),
    Reader("stored", ".npz", _stored, _file("s.npz", read_scene), JSON),
    Reader("partition", ".json", _partition, _file("b.json", read_blocks), JSON),
    Reader("classes", ".json", _json(CLASSES, {"classes": ["sky"], "vocabulary": "ade20k"}),
           _file("c.json", read_classes), JSON),
    Reader("sweep", ".toml", lambda _: [SWEEP.encode()], _file("s.toml", read_sweep), 256, 16 * MIB),
    Reader("zip", ".zip", _archive, _read_archive, DEFLATE),
)  # fmt: skip
