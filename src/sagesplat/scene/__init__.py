"""Captures: posed photos and structure-from-motion points."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from sagesplat.core.errors import SceneError
from sagesplat.core.geometry import offset_text
from sagesplat.io.colour_profile import describe_profiles
from sagesplat.scene.detect import CAPTURES, locate
from sagesplat.scene.given_masks import masks_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.scene.stored import read_scene
from sagesplat.scene.vignetting_fit import estimate_vignetting, with_vignetting

__all__ = ["describe", "load_scene"]


def load_scene(
    path: Path | str, *, downscale: int = 1, test_every: int = 8, calibrate_every: int = 0,
    alpha: Literal["auto", "background", "ignore"] = "auto", vignetting: bool = False,
    images: Path | str | None = None, fisheye: Literal["crop", "faces"] = "crop",
) -> Scene:  # fmt: skip
    """Load a capture: posed photos and structure-from-motion points.

    The format is detected: a COLMAP workspace, nerfstudio's transforms.json, a Blender scene, the folders of
    Polycam (raw data) and Record3D, cameras of Metashape in XML, or a scene that sagesplat stored. Photos and
    videos without poses are not captures: `photos.reconstruct` makes one of them.

    Args:
        path: Folder of the capture, its transforms.json, or the folder of a COLMAP model.
        downscale: Photos are this many times smaller than the files in images/. Intrinsics follow.
        test_every: Every n-th view by name is a test view; 0: none. A split that the dataset lists is kept.
        calibrate_every: Every n-th of the other views calibrates promises; 0: none, 1 is refused.
        alpha: Transparent pixels of photos. background: of an object that was cut out, composited over the
            background; ignore: pixels that do not count; auto: by their place in the photos.
        vignetting: Estimate it from the photos, which are then read without it (`View.vignetting`).
        images: Folder of the photos; None: found beside the poses.
        fisheye: Photos of wide lenses. crop: what a pinhole shows of them; faces: all, as a cube's faces.

    Returns:
        The scene; `Scene.notes` says what was decided while it was read. Photos themselves are read when they
        are needed (`scene.images.Photos`). A stored scene is returned as it was stored, whatever the
        arguments.

    Raises:
        SceneError: If nothing at `path` is a capture, a file of it is damaged, or an argument is impossible.

    Example:
        >>> from pathlib import Path
        >>> from sagesplat import load_scene
        >>> scene = load_scene(Path("captures/garden"), downscale=4)  # doctest: +SKIP
        >>> scene.views[0].camera.K, scene.points.xyz.shape  # doctest: +SKIP
    """
    path = Path(path)
    if calibrate_every < 0 or calibrate_every == 1:
        raise SceneError(f"{path}: calibrate_every {calibrate_every} leaves nothing; take 0 or >= 2")
    kind, place = locate(path)
    if kind in ("photos", "video"):
        raise SceneError(f"{path}: {kind} without poses; `sagesplat run` finds them")
    if kind == "stored":
        return read_scene(path)
    images = None if images is None else Path(images)
    if images is not None and not images.is_dir():
        raise SceneError(f"{images}: no such folder; give the folder of the photos")
    scene = CAPTURES[kind].load(
        place, downscale=downscale, test_every=test_every, images=images, fisheye=fisheye
    )
    if place != path:
        scene = replace(
            scene, notes=(f"the capture is in {place.relative_to(path).as_posix()}/", *scene.notes)
        )
    alpha = scene.alpha if alpha == "auto" else alpha
    scene = replace(scene, calibrate_every=calibrate_every, alpha=alpha)
    if vignetting and any(view.lens and view.lens.face for view in scene.views):
        no = "vignetting is not undone in faces of cubes"  # it would be that of the whole photo
        return replace(scene, notes=(*scene.notes, no))
    return with_vignetting(scene, estimate_vignetting(scene, Photos(scene.views))) if vignetting else scene


def describe(scene: Scene) -> list[tuple[str, str]]:
    """The rows that `sagesplat info` prints about a scene: (name, value)."""
    views, points = scene.views, scene.points
    sizes = sorted({(v.camera.width, v.camera.height) for v in views})
    Ks = {v.camera.K.tobytes() for v in views}
    lenses = sorted({v.lens.model for v in views if v.lens})
    offsets = np.array([v.camera.K[:2, 2] - [v.camera.width / 2, v.camera.height / 2] for v in views])
    kinds = (("train", scene.train_ids), ("calibration", scene.calibration_ids), ("test", scene.test_ids))
    splits = ", ".join(f"{len(ids)} {kind}" for kind, ids in kinds if len(ids) or kind != "calibration")
    low, high = offsets.min(axis=0), offsets.max(axis=0)
    falloffs = {view.vignetting for view in views if view.vignetting}
    rows = [
        ("name", scene.name),
        ("path", str(scene.path)),
        ("views", f"{len(views)} ({splits})"),
        *(("read", note) for note in scene.notes),
        ("image size", ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (", ..." if len(sizes) > 3 else "")),
        ("cameras", f"{len(Ks)} distinct intrinsics"),
        (
            "principal point",
            f"x {low[0]:+.1f} to {high[0]:+.1f}, y {low[1]:+.1f} to {high[1]:+.1f} px off centre",
        ),
        ("distortion", f"{', '.join(lenses)}: undistorted when loaded" if lenses else "none"),
        *(
            ("vignetting", f"{lens.lost:.0%} of the light is lost in the corners, corrected")
            for lens in falloffs
        ),
        ("points", f"{len(points.xyz):,}" + ("" if len(points.track_points) else ", without tracks")),
        ("extent", f"{scene.extent:.3g} world units"),
    ]
    if any(scene.offset):
        rows.append(("offset", f"{offset_text(scene.offset)}, subtracted from all positions"))
    if len(points.track_points):
        depth, error = _depth_and_error(scene)
        length = len(depth) / len(np.unique(points.track_points))
        near, middle, far = np.quantile(depth, [0, 0.5, 1])
        rows += [
            ("mean track length", f"{length:.2f} views"),
            ("reprojection error", f"{np.median(error):.2f} px median"),
            ("depth of points", f"{near:.3g} nearest, {middle:.3g} median, {far:.3g} farthest"),
        ]
    rows += [("colours", line) for line in describe_profiles(view.image_path for view in views)]
    masks = scene.path / "masks"
    num_masks = len(list(masks.glob("**/*.png")))
    given = masks_of(scene)
    if num_masks and masks not in given.folders:
        rows.append(("masks", f"{num_masks} label images in {masks.name}/"))
    elif not given:
        rows.append(("masks", "no masks/ folder"))
    return rows


def _depth_and_error(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Per observation: depth of the point in the view, world units [T], and reprojection error, px [T]."""
    points = scene.points
    w2c = np.stack([v.camera.w2c for v in scene.views])[points.track_views]
    K = np.stack([v.camera.K for v in scene.views])[points.track_views]
    xyz = np.einsum("tij,tj->ti", w2c[:, :3, :3], points.xyz[points.track_points]) + w2c[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        uvw = np.einsum("tij,tj->ti", K, xyz)
        error = np.linalg.norm(uvw[:, :2] / uvw[:, 2:] - points.track_uv, axis=1)
    return xyz[:, 2], error
