"""Readers of captures: photos, videos, COLMAP, nerfstudio, point clouds, label images."""

import io
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image, ImageCms

from sagesplat.core.errors import SceneError
from sagesplat.io.pictures import PictureError
from sagesplat.scene import _prepare, photos, video
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.exif import exposure_of
from sagesplat.scene.images import has_alpha, load_alpha, load_photo, photo_size, read_black
from sagesplat.scene.nerfstudio import load_transforms
from sagesplat.scene.points import read_points
from sagesplat.scene.scans import load_metashape, load_polycam, load_record3d
from sagesplat.scene.scene import Camera, View
from sagesplat.segment.coco import read_panoptic
from sagesplat.segment.instances import read_instances, write_instances
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Taxonomy, read_mask, write_mask
from tests.colmap_text import write_text_model
from tests.fuzz.hostile import MIB, Reader
from tests.fuzz.readers.making import PHOTOS, as_json, documents, file, put, put_photos, written, written_by

TAXONOMY = Taxonomy({1: "sky", 2: "tree"})
FRAMES = video._Extracted(size=9, mtime_ns=9, max_frames=9, frames=[])
CAMERA = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 16, 12)


def _colmap(part: str, text: bool) -> Reader:
    """One file of a COLMAP workspace, whose others are sound."""
    name = f"{part}{'.txt' if text else '.bin'}"
    base = {"cameras": "PINHOLE", "images": "PINHOLE", "points3D": "OPENCV"}[part]

    def make(folder: Path, size: int) -> list[bytes]:
        put_photos(folder / "images")
        (folder / "sparse").mkdir(exist_ok=True)
        params = (14.0, 14.0, 8.0, 6.0) + (0.01, 0.0, 0.0, 0.0) * (base == "OPENCV")
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 0, 3] = [0, 0.1, 0.2]
        count = 2 * size
        uv, rows = np.tile([[8.0, 6.0], [3.0, 4.0]], (size, 1)), np.arange(count)
        seen = rows, rows[::-1], np.full(count, -1)
        images = [ModelImage(i + 1, PHOTOS[i], 1, pose, uv, seen[i]) for i, pose in enumerate(poses)]
        xyz, rgb = np.tile([[0, 0, 4.0], [1, 0, 5]], (size, 1)), np.full((count, 3), 7, np.uint8)
        cameras = [ModelCamera(i + 1, base, 16, 12, params) for i in range(size)]
        write = write_text_model if text else write_model
        write(folder / "sparse", cameras, images, xyz, rgb, np.ones(count))
        return [(folder / "sparse" / name).read_bytes()]

    read = file(f"sparse/{name}", lambda path: load_colmap(path.parents[1]))
    # Without points there are 100,000 random ones.
    limits = (3000, 64 * MIB) if part == "points3D" else ()
    return Reader(f"colmap-{name.replace('.', '-')}", name[-4:], make, read, *limits)


def points(folder: Path, size: int) -> list[bytes]:
    """Point clouds in PLY, as text and as numbers."""
    head = f"element vertex {2 * size}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue")) + "end_header\n"
    table = np.zeros(2 * size, [("xyz", ">f4", 3), ("rgb", "u1", 3)])
    return [
        f"ply\nformat ascii 1.0\n{head}".encode() + b"0 1 2 3 4 5\n6 7 8 9 10 11\n" * size,
        f"ply\nformat binary_big_endian 1.0\n{head}".encode() + table.tobytes(),
    ]


def _transforms(folder: Path, size: int) -> list[bytes]:
    put_photos(folder / "images")
    (folder / "points.ply").write_bytes(points(folder, 1)[0])
    frames = []
    for i, name in enumerate(PHOTOS):
        matrix = np.eye(4)
        matrix[0, 3] = i
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    shared = {"w": 16, "h": 12, "fl_x": 14.0, "cx": 8.0, "k1": 0.01, "ply_file_path": "points.ply"}
    shared |= {f"note{i}": [i, 0.5] for i in range(size - 1)}  # type: ignore
    listed = {"train_filenames": [f"images/{n}" for n in PHOTOS]}
    return as_json({**shared, "frames": frames}, {**shared, **listed, "camera_angle_x": 1, "frames": frames})


def _polycam(folder: Path, size: int) -> list[bytes]:
    """A camera of Polycam, beside two others that are sound."""
    put_photos(folder / "keyframes/images")
    cameras = []
    for i in range(len(PHOTOS)):
        camera = dict.fromkeys((f"t_{row}{column}" for row in range(3) for column in range(4)), 0.0)
        camera |= {"t_00": 1.0, "t_11": 1.0, "t_22": 1.0, "t_03": i, "fx": 14, "fy": 14, "cx": 8, "cy": 6}
        cameras.append(camera | {"width": 16, "height": 12} | {f"note{n}": 0.5 for n in range(size - 1)})
    for name, camera in zip(PHOTOS[1:], cameras[1:], strict=True):
        put(folder / "keyframes/cameras" / f"{Path(name).stem}.json", json.dumps(camera).encode())
    return as_json(cameras[0])


def _record3d(folder: Path, size: int) -> list[bytes]:
    (folder / "rgbd").mkdir(parents=True, exist_ok=True)
    for i in range(3):
        Image.new("RGB", (16, 12)).save(folder / "rgbd" / f"{i}.jpg")
    poses = [[0, 0, 0, 1, i, 0, 0] for i in range(2 + size)]
    made = {"w": 16, "h": 12, "K": [14, 0, 0, 0, 14, 0, 8, 6, 1], "poses": poses}
    return as_json(made, {**made, "perFrameIntrinsicCoeffs": [[14, 14, 8, 6]] * len(poses)})


def _metashape(folder: Path, size: int) -> list[bytes]:
    put_photos(folder)
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1"
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" label="{name}"><transform>{pose.format(i)}</transform></camera>'
        for i, name in enumerate(PHOTOS)
    )
    cameras += "".join(f'<camera id="{i}" label="x"/>' for i in range(size - 1))
    values = '<resolution width="16" height="12"/><f>14</f><cx>0.5</cx><k1>0.01</k1><p1>0.001</p1>'
    return [
        f'<?xml version="1.0"?><document version="2.0.0"><chunk><sensors><sensor id="0" type="{kind}">'
        f'<calibration type="{kind}">{values}</calibration></sensor></sensors><cameras>{cameras}</cameras>'
        f"<transform><scale>2</scale></transform></chunk></document>".encode()
        for kind in ("frame", "spherical")
    ]


def _profiled() -> bytes:
    """A colour profile that is not sRGB's: red and blue are exchanged."""
    content = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    content = content.replace("sRGB".encode("utf-16-be"), "tRGB".encode("utf-16-be"))
    return content.replace(b"rXYZ", b"    ").replace(b"bXYZ", b"rXYZ").replace(b"    ", b"bXYZ")


def _picture(mode: str, size: int, **options: Any) -> bytes:
    content = io.BytesIO()
    Image.new(mode, (16 * size, 12 * size), 9).save(content, **options)
    return content.getvalue()


def _photos(folder: Path, size: int) -> list[bytes]:
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    exif.get_ifd(0x8769)[0x920A] = 24.0
    return [
        _picture("RGB", size, format="PNG"),
        _picture("RGB", size, format="JPEG", exif=exif),
        _picture("RGB", size, format="JPEG", icc_profile=_profiled()),
        _picture("L", size, format="JPEG"),
        _picture("LA", size, format="PNG"),
        _picture("I;16", size, format="PNG"),
        _picture("P", size, format="PNG", transparency=0),
        _picture("RGB", size, format="WEBP"),
        _picture("RGB", size, format="TIFF", compression="tiff_lzw"),
        _picture("F", size, format="TIFF"),
        _picture("RGB", size, format="BMP"),
    ]


def _read_photo(path: Path) -> None:
    photo_size(path)
    has_alpha(path)
    exposure_of(path)
    load_photo(View("a", CAMERA, path))
    load_alpha(path)


def _prepare_photo(path: Path) -> None:
    """What structure from motion does first; its errors become a list of photos that cannot be read."""
    for old in (path.parent / "prepared").glob("*"):
        old.unlink()
    (path.parent / "prepared").mkdir(exist_ok=True)
    try:
        _prepare._prepare_photo(path, path.parent / "prepared", "p")
    except PictureError as error:
        raise SceneError(str(error)) from None


def _masks(folder: Path, size: int) -> list[bytes]:
    ids = np.ones((3 * size, 4 * size), np.int16)  # of one category: nothing is packed better
    if size == 1:
        ids[:2] = [[1, 2, -1, 1], [2, 2, 1, 1]]
    small, large = Taxonomy({1: "sky", 2: "tree"}), Taxonomy({1: "sky", 2: "tree", 300: "car"})
    return [written(folder / "m.png", partial(_write_mask, ids, t)) for t in (small, large)]


def _write_mask(ids: np.ndarray, taxonomy: Taxonomy, path: Path) -> None:
    write_mask(path, ids, taxonomy)


def _write_instances(path: Path, size: int) -> None:
    numbers = np.zeros((3 * size, 4 * size), np.int16)
    numbers[:2, :3] = [[1, 2, -1], [2, 2, 1]]
    write_instances(path, numbers)


def _valid(folder: Path, size: int) -> list[bytes]:
    """Masks of pixels that count, of all modes of PNG that have other rows in memory."""
    return [_picture(mode, size, format="PNG") for mode in ("1", "L", "LA", "RGB", "RGBA", "I;16", "P")]


def _import(folder: Path, content: bytes) -> None:
    """A label image for photo a.png, in the user's folder."""
    from sagesplat.scene.scene import Points, Scene

    put(folder / "given/a.png", content)
    (folder / "given/labels.json").write_text('{"labels": {"1": "sky", "2": "tree"}}')
    none = np.zeros((0, 3), np.float32)
    rows = np.zeros(0, np.int64)
    cloud = Points(none, none.astype(np.uint8), rows, rows.astype(np.int32), none[:, :2])
    scene = Scene("s", folder, (View("a.png", CAMERA, folder / "a.png"),), cloud)
    import_masks(scene, folder / "given", folder / "taken")


def _panoptic(size: int) -> Any:
    segments = [{"id": 7 + i, "category_id": 1} for i in range(size)]
    entries = [{"file_name": "a.png", "segments_info": segments}]
    return {"categories": [{"id": 1, "name": "sky"}], "annotations": entries}


def _read_frames(path: Path) -> None:
    (path.parent / "frame_000001.jpg").touch()
    video._finished(path.parent, FRAMES)


def _videos(folder: Path, size: int) -> list[bytes]:
    """Three frames in which a bright square moves."""
    files = []
    for kind, codec in (("mp4", "mpeg4"), ("avi", "mjpeg")):
        content = io.BytesIO()
        with av.open(content, "w", kind) as container:
            stream: Any = container.add_stream(codec, rate=5)
            stream.width, stream.height = 16 * size, 16 * size
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for i in range(3):
                pixels = np.zeros((16 * size, 16 * size, 3), np.uint8)
                pixels[: 8 * size, 4 * i * size : 4 * (i + 1) * size] = 255
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels)))
            container.mux(stream.encode())
        files.append(content.getvalue())
    return files


def _read_video(path: Path) -> None:
    (path.parent / "frames/video.json").unlink(missing_ok=True)
    video.extract_frames(path, path.parent / "frames", max_frames=9)


REQUEST = {"photos": ["a.jpg"], "cameras": ["auto"], "matching": "exhaustive", "seed": 0}
POSES = {
    "complete": True,
    **dict.fromkeys(photos.Reconstruction.__dataclass_fields__, 1),
    "unregistered": {"a.jpg": "no overlap"},
    "seconds": {"mapping": 1.5},
}


def _poses(folder: Path, size: int) -> list[bytes]:
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    put(folder / "sfm/request.json", json.dumps(REQUEST).encode())
    return as_json(POSES | {"unregistered": {f"{i}.jpg": "no overlap" for i in range(size)}})


READERS = (
    Reader("photo", ".png", _photos, file("a.png", _read_photo), 100, 16 * MIB),
    Reader("prepare", ".jpg", _photos, file("a.jpg", _prepare_photo), 100, 16 * MIB),
    *(_colmap(part, text) for part in ("cameras", "images", "points3D") for text in (False, True)),
    Reader("ply-points", ".ply", points, file("p.ply", read_points)),
    # Without a PLY file there are 100,000 random points.
    Reader("transforms", ".json", _transforms, file("transforms.json", load_transforms), 3000, 64 * MIB),
    Reader("polycam", ".json", _polycam,
           file("keyframes/cameras/a.json", lambda path: load_polycam(path.parents[2])), 3000, 64 * MIB),
    Reader("record3d", ".json", _record3d,
           file("metadata.json", lambda path: load_record3d(path.parent)), 3000, 64 * MIB),
    Reader("metashape", ".xml", _metashape,
           file("cameras.xml", lambda path: load_metashape(path.parent)), 3000, 64 * MIB),
    Reader("mask", ".png", _masks, file("m.png", lambda path: read_mask(path, TAXONOMY))),
    Reader("instances", ".png", written_by("i.png", _write_instances), file("i.png", read_instances)),
    Reader("label-image", ".png", _masks, _import),
    Reader("valid", ".png", _valid, file("v.png", lambda path: read_black(path, 192)), 100, 16 * MIB),
    Reader("labels", ".json", documents(lambda n: {"labels": {str(i): f"thing {i}" for i in range(n)}}),
           file("labels.json", Taxonomy.read), 1000),
    Reader("panoptic", ".json", documents(_panoptic),
           file("p.json", lambda path: read_panoptic(path.parent)), 1000),
    Reader("video", ".mp4", _videos, file("v.mp4", _read_video), 60, 16 * MIB),
    Reader("video-frames", ".json",
           documents(lambda n: asdict(FRAMES) | {"frames": ["frame_000001.jpg"] * n}),
           file("video.json", _read_frames), 1000),
    Reader("poses-request", ".json",
           documents(lambda n: REQUEST | {"photos": ["a.jpg"] * n, "min_photos": 3, "threads": -1}),
           file("sfm/request.json", lambda path: photos._resume(path.parents[1], REQUEST)), 1000),
    Reader("poses", ".json", _poses,
           file("poses.json", lambda path: photos._resume(path.parent, REQUEST)), 1000),
)  # fmt: skip
