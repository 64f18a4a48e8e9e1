"""Loads what scanner apps and Metashape export: Polycam's and Record3D's folders, cameras in Metashape's XML.

Each is turned into the frames of a transforms.json, which `nerfstudio.load_transforms` loads: camera to world
with OpenGL axes, in the file's own world. Photos are found by `find_photos`. Depth images are not read.

Polycam, raw data: keyframes/images/N.jpg with keyframes/cameras/N.json, or corrected_images and
corrected_cameras, which Polycam made by bundle adjustment. Record3D: rgbd/N.jpg or rgb/N.jpg, and
metadata.json (metadata in an unpacked .r3d) with `K` (by columns), `poses` (quaternion x y z w, then the
position) and `perFrameIntrinsicCoeffs`. Metashape: "Export Cameras" as Agisoft XML; camera models are those
of its manual, appendix D.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64
from msgspec import Meta
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError, short
from sagesplat.core.names import repaired
from sagesplat.io.files import read_json, regular
from sagesplat.io.typed import convert_as, refused
from sagesplat.scene.nerfstudio import LARGEST, load_transforms
from sagesplat.scene.scene import Scene

_DEPTHS = (".depth", ".exr")  # files of Record3D, besides folders named depth
_LARGEST_XML = 2**26  # bytes; a camera takes about a thousand
_NO_PIXELS = 0.5  # by which coefficients that other camera models lack may move a photo's corner
_Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
_Quaternion = Annotated[list[_Number], Meta(min_length=7, max_length=7)]
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # between cameras that look along z, y down, and along -z, y up
_METASHAPE_CURE = "export the cameras again (File, Export, Export Cameras, Agisoft XML)"


def load_polycam(path: Path, **reading: Any) -> Scene:
    """The scene of Polycam's raw data; `reading` as of `load_transforms`. Raises SceneError."""
    cameras = polycam_cameras(path)
    if cameras is None:
        raise SceneError(f"{path}: no keyframes/ with cameras; export Polycam's raw data again")
    kind = "corrected_" if cameras.name == "corrected_cameras" else ""
    photos = cameras.with_name(f"{kind}images")
    photos = photos if photos.is_dir() else cameras.with_name("images")
    frames = [_polycam_frame(file) for file in sorted(cameras.glob("*.json"), key=_number)]
    notes = [f"poses: {cameras.name}/ of Polycam"]
    notes += _depth_notes(cameras.parent, "depth", "confidence")
    return _scene(path, cameras, frames, photos, notes, reading)


def polycam_cameras(folder: Path) -> Path | None:
    """Of Polycam's export of raw data the folder with the poses: corrected ones, where there are some."""
    names = [name for name in ("corrected_cameras", "cameras") if (folder / "keyframes" / name).is_dir()]
    places = [folder / "keyframes" / name for name in names]
    if not names and folder.name == "keyframes":
        places = [folder / "corrected_cameras", folder / "cameras"]
    return next((place for place in places if next(place.glob("*.json"), None)), None)


def _polycam_frame(file: Path) -> dict[str, Any]:
    """The frame of a camera of Polycam, whose t_ij are row i of camera to world."""
    rows = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    content = read_json(file, "export the raw data again", SceneError)
    with refused(file, "a camera of Polycam", "export the raw data again", SceneError):
        camera = convert_as(content, dict[str, Any])
        names = ["fx", "fy", "cx", "cy", "width", "height", *chain(*rows)]
        camera = convert_as({name: camera.get(name) for name in names}, dict[str, _Number])
    return {
        "file_path": file.stem, "w": camera["width"], "h": camera["height"],
        "fl_x": camera["fx"], "fl_y": camera["fy"], "cx": camera["cx"], "cy": camera["cy"],
        "transform_matrix": [[camera[name] for name in row] for row in rows],
    }  # fmt: skip


def is_record3d(folder: Path) -> bool:
    """Whether a folder is Record3D's export of photos with metadata."""
    return _record3d_file(folder).is_file() and _record3d_photos(folder) is not None


def _record3d_file(folder: Path) -> Path:
    inside = folder / "metadata"  # in an .r3d, which is an archive
    return inside if inside.is_file() else folder / "metadata.json"


def _record3d_photos(folder: Path) -> Path | None:
    return next((folder / name for name in ("rgbd", "rgb") if (folder / name).is_dir()), None)


@dataclass(frozen=True)
class _Record3D:
    w: _Number
    h: _Number
    K: Annotated[list[_Number], Meta(min_length=9, max_length=9)]
    poses: list[_Quaternion]
    perFrameIntrinsicCoeffs: list[list[_Number]] | None = None


def load_record3d(path: Path, **reading: Any) -> Scene:
    """The scene of Record3D's photos and metadata.json; `reading` as of `load_transforms`. SceneError."""
    file, photos = _record3d_file(path), _record3d_photos(path)
    if photos is None:
        raise SceneError(f"{path}: no rgbd/ or rgb/ beside metadata.json; export it again, with photos")
    content = read_json(file, "export it from Record3D again", SceneError)
    with refused(file, "metadata of Record3D", "export it from Record3D again", SceneError):
        made = convert_as(content, _Record3D)
        own = made.perFrameIntrinsicCoeffs or []
        if own and (len(own) != len(made.poses) or any(len(values) < 4 for values in own)):
            raise ValueError(f"intrinsics of {len(own)} frames for {len(made.poses)} poses")
        poses = np.array(made.poses, np.float64).reshape(-1, 7)
        if not (np.linalg.norm(poses[:, :4], axis=1) > 1e-6).all():
            raise ValueError("a pose without a rotation")
    frames = []
    for number, pose in enumerate(poses):
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = Rotation.from_quat(pose[:4]).as_matrix(), pose[4:]
        fx, fy, cx, cy = own[number][:4] if own else (made.K[0], made.K[4], made.K[6], made.K[7])
        frames.append({
            "file_path": str(number), "w": made.w, "h": made.h, "fl_x": fx, "fl_y": fy,
            "cx": cx, "cy": cy, "transform_matrix": c2w.tolist(),
        })  # fmt: skip
    notes = [f"poses: {file.name} of Record3D", *_depth_notes(path, "depth", photos.name)]
    return _scene(path, file, frames, photos, notes, reading)


def metashape_file(folder: Path) -> Path | None:
    """The XML file of Metashape's cameras in a folder, where it holds one."""
    return next((file for file in sorted(folder.glob("*.xml")) if is_metashape_xml(file)), None)


def is_metashape_xml(file: Path) -> bool:
    """Whether an XML file is of Metashape's cameras."""
    try:
        with regular(file).open("rb") as opened:
            head = opened.read(4096).replace(b"\0", b"")  # of UTF-16, too
    except OSError:
        return False
    return b"<document" in head and b"<chunk" in head


def load_metashape(path: Path, **reading: Any) -> Scene:
    """The scene of Metashape's cameras, an XML file or its folder; `reading` as of `load_transforms`.

    Photos are found by the cameras' labels, beside the file or below it. SceneError.
    """
    file = path if path.is_file() else metashape_file(path)
    if file is None:
        raise SceneError(f"{path}: no XML file of Metashape's cameras; {_METASHAPE_CURE}")
    try:
        content = regular(file).read_bytes()
        plain = content.replace(b"\0", b"")  # UTF-16 has zeros between
        if len(content) > _LARGEST_XML or b"<!DOCTYPE" in plain or b"<!ENTITY" in plain:
            raise ValueError("too large, or with entities")
        chunks = ElementTree.fromstring(content).findall("chunk")
        if len(chunks) != 1:
            raise ValueError(f"{len(chunks)} chunks; export one")
        frames, total = _metashape_frames(chunks[0])
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror}); {_METASHAPE_CURE}") from None
    except (ValueError, ElementTree.ParseError) as error:
        raise SceneError(f"{file}: not cameras of Metashape ({short(error)}); {_METASHAPE_CURE}") from None
    if not frames:
        raise SceneError(f"{file}: none of its {total} cameras has a pose; align the photos in Metashape")
    notes = [f"poses: {short(file.name)} of Metashape; {len(frames)} of {total} cameras have one"]
    return _scene(file.parent, file, frames, file.parent, notes, reading)


def _metashape_frames(chunk: ElementTree.Element) -> tuple[list[dict[str, Any]], int]:
    """The frames of the aligned cameras, and the number of all cameras."""
    lenses = {sensor.get("id"): _metashape_lens(sensor) for sensor in chunk.iterfind("sensors//sensor")}
    parts = {one.get("id"): one.find("transform") for one in chunk.iterfind("components//component")}
    frames, cameras = [], list(chunk.iterfind("cameras//camera"))
    for camera in cameras:
        placed, label = camera.findtext("transform"), (camera.get("label") or "").strip()
        if placed is None or not label or camera.get("enabled", "true").lower() in ("false", "0"):
            continue
        lens = lenses.get(camera.get("sensor_id"))
        if lens is None:
            raise ValueError(f"camera {short(repr(label))} without a calibrated sensor")
        c2w = _floats(placed, 16).reshape(4, 4)
        part = parts.get(camera.get("component_id"))
        c2w = _to_world(part if part is not None else chunk.find("transform")) @ c2w
        c2w[:3, :3] /= np.cbrt(max(np.linalg.det(c2w[:3, :3]), 1e-30))  # positions keep the scale
        frames.append({"file_path": label, "transform_matrix": (c2w @ _OPENGL).tolist(), **lens})
    return frames, len(cameras)


def _to_world(transform: ElementTree.Element | None) -> Float64[np.ndarray, "4 4"]:
    """From a chunk's or component's own axes to the world."""
    matrix = np.eye(4)
    if transform is None:
        return matrix
    if (rotation := transform.findtext("rotation")) is not None:
        matrix[:3, :3] = _floats(rotation, 9).reshape(3, 3)
    if (scale := transform.findtext("scale")) is not None:
        matrix[:3, :3] *= _floats(scale, 1)
    if (translation := transform.findtext("translation")) is not None:
        matrix[:3, 3] = _floats(translation, 3)
    return matrix


def _metashape_lens(sensor: ElementTree.Element) -> dict[str, Any] | None:
    """Intrinsics as a transforms file has them; None for a sensor that is not calibrated.

    The point (x, y) of a pinhole with z = 1, or for fisheyes that in its direction at the distance of the
    angle, is seen at f (x', y') + b1 x' + b2 y' + (cx, cy) from the middle of the photo, for
    x' = x (1 + k1 r^2 + ... + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y, and y' with p1 and p2 exchanged.
    """
    found = sensor.findall("calibration")
    if not found:
        return None
    calibration = next((one for one in found if one.get("class") == "adjusted"), found[-1])
    kind = calibration.get("type") or sensor.get("type") or "frame"
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError("a sensor without a resolution")
    width, height = (float(size.get(name) or "nan") for name in ("width", "height"))
    if kind in ("spherical", "cylindrical"):
        return {"camera_model": kind.upper(), "w": width, "h": height, "fl_x": width}
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"a sensor of type {short(kind)}")

    def value(name: str) -> float:
        text = calibration.findtext(name)
        return 0.0 if text is None else float(_floats(text, 1)[0])

    f = value("f")
    if not f > 0:
        raise ValueError("a sensor without a focal length")
    k1, k2, k3, k4, p1, p2 = map(value, ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens: dict[str, Any] = {"w": width, "h": height, "fl_x": f + value("b1"), "fl_y": f}
    lens |= {"cx": width / 2 + value("cx"), "cy": height / 2 + value("cy")}
    corner = float(np.hypot(width, height) / 2 / f)
    moved = {"b2": value("b2") * height / 2 / f}
    if kind == "fisheye":
        moved |= {name: 3 * f * p * corner**2 for name, p in (("p1", p1), ("p2", p2))}
        lens |= {"camera_model": "OPENCV_FISHEYE", "k1": k1, "k2": k2, "k3": k3, "k4": k4}
    else:
        moved |= {"k4": f * k4 * corner**9}
        lens |= {"camera_model": "OPENCV", "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}  # OpenCV's order
    for name, pixels in moved.items():
        if abs(pixels) > _NO_PIXELS:
            raise ValueError(
                f"{name} moves a corner by {abs(pixels):.1f} px, and no camera model here has it with a "
                f"{kind} camera; optimise the cameras without it"
            )
    return lens


def _floats(text: str, count: int) -> Float64[np.ndarray, " n"]:
    words = text.split()
    if len(words) != count:
        raise ValueError(f"{len(words)} numbers in place of {count}")
    values = np.array(words, np.float64)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite")
    return values


def _number(file: Path) -> tuple[int, str]:
    return int(file.stem) if file.stem.isdecimal() and len(file.stem) < 19 else 0, file.stem


def _depth_notes(folder: Path, *names: str) -> Iterator[str]:
    """A line on depth images, if there are some."""
    depths = [
        path for name in names for path in (folder / name).glob("*")
        if name in ("depth", "confidence") or path.suffix.lower() in _DEPTHS
    ]  # fmt: skip
    if depths:
        yield f"{len(depths)} depth images are not used"


def _scene(
    path: Path, file: Path, frames: list[dict[str, Any]], photos: Path, notes: list[str],
    reading: dict[str, Any],
) -> Scene:  # fmt: skip
    """The scene of frames, named as `file` names them, whose photos are in a folder."""
    if not frames:
        raise SceneError(f"{file}: no camera; export it again")
    reading = {**reading, "images": reading.get("images") or photos}
    scene = load_transforms(file, content={"frames": frames}, **reading)
    return replace(scene, name=repaired(path.resolve().name), path=path, notes=(*notes, *scene.notes))
