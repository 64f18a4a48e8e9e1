"""COLMAP models and photos in the places where other tools put them."""

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_scene_colmap import PINHOLE, capture, poses, project

from sagesplat.core.errors import SceneError
from sagesplat.scene import colmap, describe, load_scene, points
from sagesplat.scene.detect import detect
from sagesplat.scene.points import random_points


def moved(folder: Path, model: str, photos: str = "images") -> Path:
    """A capture of five photos whose model and photos are in other places."""
    capture(folder / "made", [PINHOLE])
    for source, target in (("sparse/0", model), ("images", photos)):
        (folder / target).mkdir(parents=True, exist_ok=True)
        shutil.copytree(folder / "made" / source, folder / target, dirs_exist_ok=True)
    shutil.rmtree(folder / "made")
    return folder


PLACES = [
    ("sparse/0", "images"), ("sparse", "images"), (".", "images"), ("colmap/sparse/0", "images"),
    ("sparse/1", "images"), ("sparse_text", "images"), ("sparse/0_text", "images"),
    ("dense/sparse", "dense/images"),
    ("dense/0/sparse", "dense/0/images"), ("distorted/sparse/0", "input"), ("house/sparse/0", "house/images"),
    ("house/colmap/sparse/0", "house/images"), ("sparse/0", "input"), ("sparse/0", "photos"),
    ("sparse/0", "."),
    ("undistorted", "undistorted/images"), ("sparse/0", "images_2"), ("model", "rgb"),
]  # fmt: skip


@pytest.mark.parametrize(("model", "photos"), PLACES)
def test_models_and_photos_are_found(tmp_path, model, photos):
    folder = moved(tmp_path / "house", model, photos)
    assert detect(folder) == "colmap"
    scene = load_scene(folder, test_every=0)
    assert [v.image_path.relative_to(folder / photos).as_posix() for v in scene.views] == [
        f"part {i % 2}/{5 - i:02d}.png" for i in (4, 2, 0, 3, 1)
    ]
    assert project(scene).max() < 1e-4
    assert scene.name == "house"
    assert "5 of 5 photos have poses" in scene.notes
    place = "the folder itself" if model == "." else model
    assert (f"poses: those of {place}" in scene.notes) == (model not in ("sparse/0", "sparse"))


@pytest.mark.parametrize("below", ["sparse/0", "sparse"])
def test_the_folder_of_a_model_may_be_given(tmp_path, below, monkeypatch):
    folder = moved(tmp_path / "house", "sparse/0")
    scene = load_scene(folder / below)
    assert len(scene.views) == 5
    assert scene.name == "house"
    monkeypatch.chdir(folder / below)
    assert len(load_scene(".").views) == 5


def part_of(folder: Path, model: str, rows: slice, *, text: bool = True) -> None:
    """A model of some of the photos."""
    capture(folder / "all", [PINHOLE], text=text)
    path = folder / "all/sparse/0/images.txt"
    lines = path.read_text().split("\n")
    pairs = [lines[i : i + 2] for i in range(2, 12, 2)][rows]
    path.write_text("\n".join(line for pair in pairs for line in pair) + "\n")
    shutil.copytree(folder / "all/sparse/0", folder / model)
    shutil.copytree(folder / "all/images", folder / "images", dirs_exist_ok=True)
    shutil.rmtree(folder / "all")


def test_the_model_with_the_most_photos_is_taken_and_the_others_named(tmp_path):
    for model, rows in (("sparse/0", slice(0, 1)), ("sparse/1", slice(1, 5)), ("sparse/2", slice(0, 0))):
        part_of(tmp_path, model, rows)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert scene.notes[:2] == (
        "poses: those of sparse/1, which of 3 models has the most photos; left aside: sparse/0 (1 photos), "
        "sparse/2 (0 photos); to take another one, give its folder",
        "4 of 5 photos have poses",
    )
    assert ("read", "4 of 5 photos have poses") in describe(scene)
    with pytest.raises(SceneError, match="1 posed photos, but it takes 3"):
        load_scene(tmp_path / "sparse/0")


def test_a_damaged_model_is_never_passed_over_for_another(tmp_path):
    part_of(tmp_path, "sparse/0", slice(0, 5))
    part_of(tmp_path, "sparse/1", slice(0, 4))
    (tmp_path / "sparse/0/images.txt").write_text("1 2 3")
    with pytest.raises(SceneError, match=r"sparse/0/images\.txt: damaged"):
        load_scene(tmp_path)
    shutil.rmtree(tmp_path / "sparse/0")
    shutil.copytree(tmp_path / "sparse/1", tmp_path / "sparse/2")
    (tmp_path / "sparse/2/images.txt").write_text("1 2 3")
    assert (
        load_scene(tmp_path)
        .notes[0]
        .endswith("left aside: sparse/2 (damaged); to take another one, give its folder")
    )


def test_undistorted_photos_are_not_read_with_the_distorted_model(tmp_path):
    folder = moved(tmp_path, "sparse/0")
    shutil.copytree(folder / "sparse", folder / "distorted/sparse")
    scene = load_scene(folder)
    assert scene.notes == ("5 of 5 photos have poses",)


def test_smaller_copies_beside_the_photos_are_left_alone(tmp_path):
    folder = moved(tmp_path, "sparse/0")
    shutil.copytree(folder / "images", folder / "images_4")
    next((folder / "images").rglob("01.png")).unlink()
    scene = load_scene(folder)
    assert {view.image_path.relative_to(folder).parts[0] for view in scene.views} == {"images"}
    assert "1 of 5 posed photos are gone and left out, first 'part 0/01.png'" in scene.notes


def test_smaller_copies_in_another_format(tmp_path):
    folder = moved(tmp_path, "sparse/0")
    for photo in (folder / "images").rglob("*.png"):
        small = folder / "images_2" / photo.relative_to(folder / "images").with_suffix(".jpg")
        small.parent.mkdir(parents=True, exist_ok=True)
        Image.open(photo).resize((20, 15)).save(small)
    scene = load_scene(folder, downscale=2)
    assert {view.image_path.suffix for view in scene.views} == {".jpg"}
    assert {view.name[-4:] for view in scene.views} == {".png"}  # the names stay, whatever the size
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == (20, 15)
    next((folder / "images_2").rglob("01.jpg")).unlink()
    with pytest.raises(
        SceneError, match=r"images_2: 1 of the 5 photos in images/ are missing, first '.*01.png'"
    ):
        load_scene(folder, downscale=2)


def test_photos_elsewhere(tmp_path):
    folder = moved(tmp_path / "house", "sparse/0")
    (folder / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(SceneError, match=r"5 of the 5 photos of the model are missing, .* --images"):
        load_scene(folder)
    scene = load_scene(folder, images=tmp_path / "elsewhere")
    assert len(scene.views) == 5
    with pytest.raises(SceneError, match="nowhere: no such folder"):
        load_scene(folder, images=tmp_path / "nowhere")


@pytest.mark.parametrize("deep", ["house", "data/house"])
def test_transforms_some_folders_deeper(tmp_path, deep):
    from test_scene_nerfstudio import capture as transforms
    from test_scene_nerfstudio import write

    (tmp_path / deep).mkdir(parents=True)
    write(tmp_path / deep, transforms(tmp_path / deep))
    capture(tmp_path / deep / "colmap", [PINHOLE])
    scene = load_scene(tmp_path)
    assert scene.notes[0] == f"the capture is in {deep}/"
    assert scene.path == tmp_path / deep


@pytest.mark.parametrize("place", ["input", "images", ".", "cam0"])
def test_photos_alone(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    Image.fromarray(np.zeros((3, 4, 3), np.uint8)).save(tmp_path / place / "a.JPG")
    assert detect(tmp_path) == "photos"
    with pytest.raises(SceneError, match="photos without poses"):
        load_scene(tmp_path)


def test_models_written_by_hand(tmp_path):
    """One line a photo, blank lines and comments, tabs, a byte order mark, no points."""
    capture(tmp_path, [PINHOLE], text=True)
    model = tmp_path / "sparse/0"
    lines = (model / "images.txt").read_text().split("\n")
    records, observations = lines[2:12:2], lines[3:12:2]
    written = {
        "one line a photo": "\n".join(records),
        "blank lines": "\n\n\n".join(records),
        "comments": "# by hand\n" + "\n# next\n".join(records),
        "tabs": "\n".join("\t".join(record.split(" ", 9)) for record in records),
        "mixed": "\n".join(f"{a}\n# seen\n\n{b}" for a, b in zip(records, observations, strict=True)),
        "no end": "\r\n".join(records[:-1]) + "\r\n\r\n" + records[-1],
        "utf-8 mark": "\ufeff" + "\n".join(lines[2:]),
        "old Macintosh": "\r".join(lines[2:]),
    }
    for kind, text in written.items():
        (model / "images.txt").write_bytes(text.encode())
        scene = load_scene(tmp_path)
        assert len(scene.views) == 5, kind
        np.testing.assert_allclose(scene.views[2].camera.w2c, poses(5)[0], atol=1e-6)
        assert bool(len(scene.points.track_points)) == (kind in ("mixed", "utf-8 mark", "old Macintosh")), (
            kind
        )
    for name in ("cameras", "images"):
        path = model / f"{name}.txt"
        path.write_bytes(path.read_text(encoding="utf-8-sig").encode("utf-16"))
    assert len(load_scene(tmp_path).points.track_points) == 5 * 16


HEAD = "ply\nformat ascii 1.0\nelement vertex 2\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
COLOURS = {
    "uchar red": "1 2 3", "uchar diffuse_red": "1 2 3", "uchar r": "1 2 3", "float red": "0.004 0.008 0.012",
    "double r": "0.004 0.008 0.012",
}  # fmt: skip


@pytest.mark.parametrize("kind", COLOURS)
def test_points_of_a_ply_file(tmp_path, kind):
    capture(tmp_path, [PINHOLE])
    (tmp_path / "sparse/0/points3D.bin").unlink()
    rest = "".join(
        f"property {kind[:-3] if 'red' in kind else kind[:-1]}{c}\n"
        for c in (("red", "green", "blue") if "red" in kind else "rgb")
    )
    rows = f"0 0 0 {COLOURS[kind]}\n0.1 0 0 {COLOURS[kind]}\n"
    name = "points3D.ply" if "red" in kind else "Cloud 1.PLY"  # the only one there
    (tmp_path / "sparse/0" / name).write_text(f"{HEAD}{XYZ}{rest}end_header\n{rows}")
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.points.xyz, [[0, 0, 0], [0.1, 0, 0]])
    assert scene.points.rgb.tolist() == [[1, 2, 3]] * 2
    assert len(scene.points.track_points) == 0
    assert f"the model has no 3D points: training begins with those of {name}" in scene.notes


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("empty", [False, True])
def test_poses_without_points(tmp_path, text, empty, monkeypatch):
    monkeypatch.setattr(colmap, "random_points", partial(random_points, count=300))
    capture(tmp_path, [PINHOLE], text=text)
    path = tmp_path / "sparse/0" / ("points3D.txt" if text else "points3D.bin")
    path.unlink()
    if empty:
        path.write_bytes(b"# nothing\n" if text else b"\0" * 8)
    scene = load_scene(tmp_path)
    assert len(scene.points.xyz) == 300
    assert len(scene.points.track_points) == 0
    assert any(note.startswith("no 3D points: training begins with ") for note in scene.notes)


def test_a_model_without_cameras_is_not_passed_over(tmp_path):
    folder = moved(tmp_path, "colmap/sparse/0")
    (folder / "colmap/sparse/0/cameras.bin").unlink()
    with pytest.raises(SceneError, match=r"cameras\.txt: no such file; copy the whole model"):
        load_scene(folder)


def test_files_of_a_model_in_other_letters_and_sizes_with_decimals(tmp_path):
    capture(tmp_path, [PINHOLE], text=True)
    model = tmp_path / "sparse/0"
    cameras = (model / "cameras.txt").read_text()
    (model / "cameras.txt").write_text(cameras.replace(" 40 30 ", " 40.0 3.0e+1 "))
    for file in list(model.iterdir()):
        file.rename(file.with_name(file.name.lower().capitalize()))
    scene = load_scene(tmp_path)
    assert len(scene.points.track_points) == 5 * 16
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == (40, 30)
    (model / "Cameras.txt").write_text(cameras.replace(" 40 30 ", " 40.5 30 "))
    with pytest.raises(SceneError, match=r"size 40\.5 x 30\.0 is not of whole pixels"):
        load_scene(tmp_path)


def test_photos_that_structure_from_motion_left_out_are_counted(tmp_path):
    """They are not among those of the capture that it made."""
    capture(tmp_path, [PINHOLE])
    (tmp_path / "poses.json").write_text('{"num_photos": 9}')
    assert "5 of 9 photos have poses" in load_scene(tmp_path).notes


def test_points_that_no_photo_shows_are_not_trained_on(tmp_path, monkeypatch):
    """Those of a PLY file in UTM beside poses in local coordinates."""
    monkeypatch.setattr(points, "random_points", partial(random_points, count=300))
    capture(tmp_path, [PINHOLE])
    (tmp_path / "sparse/0/points3D.bin").unlink()
    head = HEAD.replace("2", "1") + XYZ.replace("float", "double")
    (tmp_path / "sparse/0/points3D.ply").write_text(f"{head}end_header\n512345.7 5401234.5 321.2\n")
    scene = load_scene(tmp_path)
    assert len(scene.points.xyz) == 300
    assert scene.notes[-1].startswith(
        "no photo shows any of the 1 points of points3D.ply: their origin or axes"
    )
    assert sum("random" in note for note in scene.notes) == 1


def test_points_without_errors_and_models_in_small_letters(tmp_path):
    capture(tmp_path, [PINHOLE], text=True)
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text("\n".join(" ".join(line.split()[:7]) for line in path.read_text().split("\n")[1:]))
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("PINHOLE", "pinhole"))
    assert len(load_scene(tmp_path).points.track_points) == 5 * 16
