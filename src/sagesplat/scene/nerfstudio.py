"""Loads nerfstudio's transforms.json and the Blender scenes of NeRF.

Formats: https://docs.nerf.studio/quickstart/data_conventions.html, instant-ngp's docs/nerf_dataset_tips.md,
and the synthetic scenes of Mildenhall et al. 2020. Poses are camera-to-world with OpenGL axes (x right, y up,
z back). The world frame is the file's: it is not rotated, moved or scaled.
"""

import os.path
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from sagesplat.core.errors import SceneError, short
from sagesplat.core.geometry import NO_OFFSET, Position, offset_of
from sagesplat.core.names import check_photo, repaired
from sagesplat.io.files import read_json
from sagesplat.io.typed import convert_as, refused
from sagesplat.scene import loading
from sagesplat.scene.find_photos import Found, PhotoFolder, plain
from sagesplat.scene.images import has_alpha, photo_size
from sagesplat.scene.points import random_points, read_points, seen_or_random
from sagesplat.scene.scene import Camera, Lens, Scene, View
from sagesplat.scene.undistort import SPHERE, pinhole

# Camera models by the names that nerfstudio, its converters and instant-ngp give them. What they mean is told
# by the coefficients: of the perspective ones k1 ... k3, p1, p2, of the fisheye ones k1 ... k4.
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
ARIA = "FISHEYE624"  # of Project Aria, with distortion_params: COLMAP's RAD_TAN_THIN_PRISM_FISHEYE
SPHERES = (SPHERE, "SPHERICAL")
NO_PIXELS = 1e-2  # what a coefficient may move the corners of a photo by, to be taken for zero
LARGEST = 1e9  # largest number accepted; float32 is too coarse beyond
SMALLEST = 1e-6  # scale of a camera
MAX_SHEAR = 1e-2  # largest |R^T R - I| that rounding explains
BLENDER_CUBE = 1.3  # half the side of the cube that NeRF's Blender scenes fit into (3DGS's initial points)
WHITE = (255, 255, 255)
_CURE = "give a folder with a complete transforms file"
_Given = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
_Number = _Given | None


@dataclass(frozen=True, eq=False)
class Pose:
    """Of a frame its pose, camera to world with OpenGL axes."""

    transform_matrix: Float64[np.ndarray, "rows columns"] | None = None

    def world_to_camera(self) -> Float64[np.ndarray, "4 4"]:
        """World to camera with OpenCV axes. Raises ValueError."""
        if self.transform_matrix is None:
            raise ValueError("no transform_matrix")
        return world_to_camera(self.transform_matrix)


@dataclass(frozen=True, eq=False)
class Poses:
    """Of a transforms file the poses of its frames."""

    frames: list[Pose]


@dataclass(frozen=True, eq=False)
class _Frame(Pose):
    """A frame, with values that the file states once for all of them."""

    file_path: str | None = None
    mask_path: str | None = None
    camera_model: str | None = None
    is_fisheye: Any = None
    w: _Number = None
    h: _Number = None
    fl_x: _Number = None
    fl_y: _Number = None
    camera_angle_x: _Number = None
    camera_angle_y: _Number = None
    cx: _Number = None
    cy: _Number = None
    k1: _Number = None
    k2: _Number = None
    k3: _Number = None
    k4: _Number = None
    p1: _Number = None
    p2: _Number = None
    distortion_params: Annotated[list[_Given], Meta(max_length=100)] | None = None


@dataclass(frozen=True, eq=False)
class _Transforms:
    """A transforms file; what is in its frames is read frame by frame."""

    frames: Annotated[list[dict[str, Any]], Meta(min_length=1)]
    ply_file_path: str | None = None
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None


def load_transforms(
    path: Path,
    *,
    downscale: int = 1,
    test_every: int = 8,
    images: Path | None = None,
    fisheye: loading.Fisheye = "crop",
    content: dict[str, Any] | None = None,
) -> Scene:
    """The scene of nerfstudio's or instant-ngp's transforms.json; `path` is the file or its folder.

    With `downscale` N the photos are read from `images_N/` if the frames are in images/ and that folder
    exists. Otherwise they are area-resampled. If the file lists train_, val_ or test_filenames, they define
    the split unless `test_every` is 0: `val` is used only without `test`, and unlisted frames are dropped.
    Points are read from `ply_file_path`, else made by `points.random_points`. They are in the frame of the
    poses: `applied_transform` has been applied to both. A frame's `mask_path` says which pixels count (not
    black). Depths are not read. Photos are found by `find_photos`, in the folder or in `images`; frames whose
    photo is gone are left out. `content`: of a file of another format, in place of what `path` holds. Raises
    SceneError.
    """
    file = path if path.suffix == ".json" or content else path / "transforms.json"
    loading.check_settings(path, downscale, test_every)
    transforms, frames = _read(file, content)
    offset, points = offset_of(_positions(frames)), None
    if transforms.ply_file_path is not None:
        ply = _points_file(file, transforms.ply_file_path)
        points = read_points(ply, offset)
        if any(offset) and not any(offset_of(_positions(frames), points.xyz + np.array(offset))):
            offset, points = NO_OFFSET, read_points(ply)  # cameras that hardly moved, in a wide scene
    frames = _moved(frames, offset)
    by_frame, notes = _views(file, frames, downscale, images, fisheye)
    views, test_names = [view for _, of_frame in by_frame for view in of_frame], None
    if test_every:
        views, test_names = _listed_split(file, transforms, frames, by_frame)
    ordered = _sorted(file, views, test_names)
    if points is None:
        points = random_points(ordered)
        notes.append(f"no points: training begins with {len(points.xyz):,} random ones that cameras see")
    else:
        points, more = seen_or_random(points, ordered, short(transforms.ply_file_path or ""))
        notes += more
    folder = file.parent
    return Scene(
        repaired(folder.resolve().name), folder, ordered, points, test_every, test_names=test_names,
        notes=(*notes, *loading.describe_lenses(ordered)), offset=offset,
    )  # fmt: skip


def _positions(frames: Sequence[Pose]) -> Float64[np.ndarray, "V 3"]:
    """Camera centres; frames without a pose, which are an error later, have none."""
    poses = [frame.transform_matrix for frame in frames]
    usable = [pose[:3, 3] for pose in poses if pose is not None and pose.shape in ((3, 4), (4, 4))]
    return np.array(usable, np.float64).reshape(-1, 3)


def _moved(frames: list[_Frame], offset: Position) -> list[_Frame]:
    """The frames with an offset subtracted from their positions."""
    if not any(offset):
        return frames
    moved = []
    for frame in frames:
        if frame.transform_matrix is not None:
            matrix = frame.transform_matrix.copy()
            matrix[:3, 3:] -= np.array(offset)[: len(matrix[:3]), None]
            frame = replace(frame, transform_matrix=matrix)
        moved.append(frame)
    return moved


def load_blender(
    path: Path,
    *,
    downscale: int = 1,
    test_every: int = 8,
    images: Path | None = None,
    fisheye: loading.Fisheye = "crop",
) -> Scene:
    """The scene of a NeRF Blender folder: transforms_train.json, and transforms_test.json or else _val.

    The train file's views are training views and the test file's are test views, as in 3DGS. With
    `test_every` 0 all are training views. Photos with alpha are of a cut-out object, composited over white.
    The initial points are random in the cube [-1.3, 1.3]^3. Raises SceneError.
    """
    loading.check_settings(path, downscale, test_every)
    folder = path.parent if path.suffix == ".json" else path
    train = folder / "transforms_train.json"
    tests = next(
        (f for f in (folder / "transforms_test.json", folder / "transforms_val.json") if f.is_file()), None
    )
    by_frame, notes = _views(train, _read(train)[1], downscale, images, fisheye)
    views, test_views = [view for _, of_frame in by_frame for view in of_frame], []
    if tests:
        by_frame, more = _views(tests, _read(tests)[1], downscale, images, fisheye)
        test_views = [view for _, of_frame in by_frame for view in of_frame]
        notes = [f"{file.name}: {note}" for file, said in ((train, notes), (tests, more)) for note in said]
    test_names = frozenset(view.name for view in test_views) if tests and test_every else None
    ordered = _sorted(train, [*views, *test_views], test_names)
    if has_alpha(ordered[0].image_path):
        ordered = tuple(replace(view, camera=replace(view.camera, background=WHITE)) for view in ordered)
    points = random_points(ordered, cube=BLENDER_CUBE)
    return Scene(
        repaired(folder.resolve().name), folder, ordered, points, test_every, test_names=test_names,
        alpha="background", notes=tuple(notes),
    )  # fmt: skip


def frame_cameras(file: Path) -> tuple[list[tuple[str, Camera]], bool, Position]:
    """Name and camera of each frame of a transforms file, whether all photos are there, and their offset.

    Lenses are replaced by pinholes. Without a photo, a frame (or the file) has to give its size, w and h.
    Raises SceneError.
    """
    _, frames = _read(file)
    offset = offset_of(_positions(frames))
    frames = _moved(frames, offset)
    names = [_written(file, "file_path", frame.file_path or f"{i:03}") for i, frame in enumerate(frames)]
    photos = PhotoFolder(file.parent).find(names)
    found = []
    for name, frame in zip(names, frames, strict=True):
        try:
            if (photo := photos.files.get(name)) is None and (frame.w is None or frame.h is None):
                raise ValueError("neither w and h nor its photo")
            lens = _lens(frame, file.parent / photo if photo else file)
            if lens.model == SPHERE:
                raise ValueError("a photo of 360 degrees is no single view; give the folder with its photos")
            K = pinhole(lens).astype(np.float32)
            w2c = frame.world_to_camera().astype(np.float32)
        except ValueError as error:
            cure = "export the transforms again"
            raise SceneError(f"{file}: frame {short(repr(name))}: {short(error)}; {cure}") from None
        found.append((name, Camera(w2c, K, lens.width, lens.height)))
    return found, not photos.missing, offset


def _read(file: Path, content: dict[str, Any] | None = None) -> tuple[_Transforms, list[_Frame]]:
    """The content of a transforms file, and its frames with the file's shared values filled in."""
    read = read_json(file, _CURE, SceneError) if content is None else content
    cure = 'export the transforms again, with {"frames": [...]} in them'
    with refused(file, "a transforms file", cure, SceneError):
        transforms = convert_as(read, _Transforms)
    shared = {field.name: read[field.name] for field in fields(_Frame) if field.name in read}
    frames = []
    for number, entry in enumerate(transforms.frames):
        try:
            frames.append(convert_as(shared | entry, _Frame))
        except ValueError as error:
            name = short(repr(entry.get("file_path", number)))
            raise SceneError(f"{file}: frame {name}: {short(error)}; export the transforms again") from None
    return transforms, frames


def _written(file: Path, key: str, value: Any) -> str:
    """A path as a transforms file has it; SceneError for one that no photo can have."""
    name = plain(value) if isinstance(value, str) else ""
    if not name.strip("/.") or "\0" in name:
        raise SceneError(f"{file}: {key} is {str(value)[:80]!r}; name a file relative to the folder")
    try:
        check_photo(name.lstrip("/."))
    except ValueError as error:
        raise SceneError(f"{file}: {key} {short(repr(value))}: {error}; rename the file, and here") from None
    return value


def _points_file(file: Path, value: Any) -> Path:
    """The file of `ply_file_path`, at the end of the path of another machine, too, but never outside."""
    parts = [
        part for part in plain(_written(file, "ply_file_path", value)).split("/") if part not in ("", "..")
    ]
    places = [file.parent.joinpath(*parts[start:]) for start in range(len(parts))]
    return next((place for place in places if os.path.isfile(place)), places[0])


def _views(
    file: Path, frames: Sequence[_Frame], downscale: int, images: Path | None, fisheye: loading.Fisheye
) -> tuple[list[tuple[str, list[View]]], list[str]]:
    """Of each frame whose photo is there its file_path and its views; and what is to be said about them.

    Names are relative to images/ if all photos are in it.
    """
    written = [_written(file, "file_path", frame.file_path) for frame in frames]
    root = images or file.parent
    photos = PhotoFolder(root).find(written)
    loading.check_found(photos, file.name)
    if all(name.startswith("images/") for name in photos.files.values()):
        root = root / "images"
        files = {name: found.removeprefix("images/") for name, found in photos.files.items()}
        photos = Found(root, written, files, prefix="images/")
    sized, divisor = loading.at_downscale(photos, downscale)
    there = [frame for frame, name in zip(frames, written, strict=True) if name in photos.files]
    masks = _masks(file, there)
    by_frame: list[tuple[str, list[View]]] = []
    scales: list[float] = []
    for frame, name in zip(frames, written, strict=True):
        if (below := photos.files.get(name)) is None:
            continue
        try:
            lens, w2c = _lens(frame, root / below), frame.world_to_camera()
            valid = None if frame.mask_path is None else masks[frame.mask_path]
            views = loading.views_of(below, sized[name], w2c, lens, divisor, fisheye, valid)
        except ValueError as error:
            reason = short(error)
            raise SceneError(
                f"{file}: frame {short(repr(name))}: {reason}; export the transforms again"
            ) from None
        by_frame.append((name, views))
        if frame.transform_matrix is not None:
            scales.append(float(np.linalg.norm(frame.transform_matrix[:3, 0])))
    notes = loading.describe_photos(photos)
    if np.abs(np.subtract(scales, 1)).max() > MAX_SHEAR:
        notes.append(f"the axes of the poses are {np.median(scales):.3g} long; their scale is left out")
    return by_frame, notes


def _masks(file: Path, frames: Sequence[_Frame]) -> dict[str, Path]:
    """The images that say which pixels of photos count, by mask_path. SceneError where one is missing."""
    names = [_written(file, "mask_path", f.mask_path) for f in frames if f.mask_path is not None]
    found = PhotoFolder(file.parent, all_folders=True).find(names)
    if found.missing:
        first = short(repr(found.missing[0]))
        raise SceneError(
            f"{file}: {len(found.missing)} of {len(names)} masks are missing, first {first}; add the files, "
            "or remove mask_path"
        )
    return {name: file.parent / below for name, below in found.files.items()}


def _lens(frame: _Frame, photo: Path) -> Lens:
    """A frame's lens as a COLMAP camera model; `photo` gives the size if the frame does not.

    With k3, OPENCV becomes COLMAP's FULL_OPENCV. k4 is accepted for the fisheye only, since other models
    define it differently; one that moves no pixel is none. Raises ValueError.
    """
    model = (frame.camera_model or (FISHEYE[0] if frame.is_fisheye else "OPENCV")).upper()
    if model not in (*PERSPECTIVE, *FISHEYE, *SPHERES, ARIA):
        known = ", ".join((*PERSPECTIVE, *FISHEYE, ARIA, SPHERE))
        raise ValueError(f"camera_model {short(repr(model))} is not one of {known}")
    if frame.w is None or frame.h is None:
        width, height = photo_size(photo)
    else:
        width, height = round(frame.w), round(frame.h)
    if not (0 < width <= loading.MAX_SIDE and 0 < height <= loading.MAX_SIDE):
        raise ValueError(f"size {width} x {height} is out of range")
    if model in SPHERES:  # the photo is the whole sphere, whatever its focal length is said to be
        return Lens(SPHERE, (float(width), float(height)), width, height)
    fx = _focal(frame.fl_x, frame.camera_angle_x, width)
    fy = _focal(frame.fl_y, frame.camera_angle_y, height)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise ValueError("neither fl_x nor camera_angle_x")
    cx, cy = (width / 2 if frame.cx is None else frame.cx), (height / 2 if frame.cy is None else frame.cy)
    params = (fx, fy, cx, cy)
    if model == ARIA:
        if len(given := frame.distortion_params or ()) != 12:
            raise ValueError(f"{ARIA} has 12 distortion_params, not {len(given)}")
        return Lens("RAD_TAN_THIN_PRISM_FISHEYE", (*params, *given), width, height)
    given = (frame.k1, frame.k2, frame.k3, frame.k4, frame.p1, frame.p2)
    k1, k2, k3, k4, p1, p2 = (0.0 if value is None else value for value in given)
    if model in FISHEYE and not (p1 or p2):
        return Lens(FISHEYE[0], (*params, k1, k2, k3, k4), width, height)
    corner = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    if model in FISHEYE or abs(k4) * corner**9 * max(fx, fy) > NO_PIXELS:
        raise ValueError(f"{model} has no {'p1 and p2' if model in FISHEYE else 'k4'}")
    if k3:
        return Lens("FULL_OPENCV", (*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), width, height)
    return Lens("OPENCV", (*params, k1, k2, p1, p2), width, height)


def _focal(focal: float | None, angle: float | None, side: int) -> float | None:
    """The focal length in pixels, as given or from the field of view in radians; None with neither."""
    if focal is None:
        if angle is None:
            return None
        focal = side / 2 / float(np.tan(angle / 2)) if 0 < angle < np.pi else 0.0
    if not focal > 0:
        raise ValueError("the focal length (fl_x, fl_y) or angle (camera_angle_x, _y) is out of range")
    return focal


def world_to_camera(c2w: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "4 4"]:
    """World to camera with OpenCV axes, from camera to world with OpenGL axes. Raises ValueError."""
    if c2w.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix has shape {c2w.shape}, not 4 x 4")
    if not (np.abs(c2w) <= LARGEST).all():
        raise ValueError(f"transform_matrix has values that are not finite or above {LARGEST:g}")
    if len(c2w) == 4 and np.abs(c2w[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("the last row of transform_matrix is not 0 0 0 1 (is it transposed?)")
    axes = c2w[:3, :3]
    # of all three: the scale of the camera's node, which turns nothing
    length = np.sqrt((axes * axes).sum() / 3)
    axes = axes / (length if length > SMALLEST else 1)
    shear = np.abs(axes.T @ axes - np.eye(3)).max()
    if shear > MAX_SHEAR:
        lengths = ", ".join(f"{each:.3g}" for each in np.linalg.norm(c2w[:3, :3], axis=0))
        raise ValueError(f"transform_matrix is no rotation (axes {lengths} long); apply the camera's scale")
    if np.linalg.det(axes) < 0:
        raise ValueError("transform_matrix is a reflection (left-handed axes)")
    u, _, vt = np.linalg.svd(axes)  # the nearest rotation
    w2c = np.eye(4)
    w2c[:3, :3] = (u @ vt * [1, -1, -1]).T  # y and z have opposite directions in OpenGL
    w2c[:3, 3] = -w2c[:3, :3] @ c2w[:3, 3]
    return w2c


def _listed_split(
    file: Path, content: _Transforms, frames: Sequence[_Frame], by_frame: Sequence[tuple[str, list[View]]]
) -> tuple[list[View], frozenset[str] | None]:
    """The views that the file's lists name, and the names of the test views (None without lists)."""
    lists = {
        kind: names for kind in ("train", "test", "val") if (names := getattr(content, f"{kind}_filenames"))
    }
    views = [view for _, of_frame in by_frame for view in of_frame]
    if not lists:
        return views, None
    of_frames = {plain(name): {view.name for view in of_frame} for name, of_frame in by_frame}
    every = {plain(frame.file_path or "") for frame in frames}
    names: dict[str, set[str]] = {}
    for kind, given in lists.items():
        listed = [plain(_written(file, f"{kind}_filenames", name)) for name in given]
        unknown = [name for name in listed if name not in every]
        if unknown:
            raise SceneError(
                f"{file}: {len(unknown)} of {len(listed)} names in {kind}_filenames are of no frame, first "
                f"{short(repr(unknown[0]))}; list the file_path of frames, or leave the list out"
            )
        # a photo that is gone has no view
        names[kind] = {view for name in listed for view in of_frames.get(name, ())}
    every = {view.name for view in views}
    tests = names.get("test") or names.get("val") or every - names["train"]
    train = names.get("train") or every - tests
    if train & tests:
        raise SceneError(
            f"{file}: {len(train & tests)} photos are listed for training and for tests, first "
            f"{min(train & tests)!r}; take them out of one list"
        )
    return [view for view in views if view.name in train | tests], frozenset(tests)


def _sorted(file: Path, views: Sequence[View], test_names: frozenset[str] | None) -> tuple[View, ...]:
    """The views sorted by name. SceneError for a duplicate name, or too few training views."""
    ordered = tuple(sorted(views, key=lambda view: view.name))
    for a, b in pairwise(ordered):
        if a.name == b.name:
            raise SceneError(f"{file}: the frames name {a.name!r} twice; remove one of them")
    count = sum(view.name not in (test_names or ()) for view in ordered)
    if count < loading.MIN_VIEWS:
        raise SceneError(
            f"{file}: {count} posed photos to train on, but it takes {loading.MIN_VIEWS}; add some"
        )
    return ordered
