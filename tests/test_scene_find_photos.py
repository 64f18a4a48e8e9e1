"""Names of photos as other tools, disks and people write them, and the files that they mean."""

import os
import unicodedata
from pathlib import Path, PurePosixPath

import pytest

from sagesplat.scene.find_photos import PhotoFolder, plain


def folder(at: Path, *files: str) -> PhotoFolder:
    for file in files:
        path = at / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return PhotoFolder(at)


NFC, NFD = (unicodedata.normalize(form, "Überblick ä.jpg") for form in ("NFC", "NFD"))
WRITTEN = [  # as written, and as on the disk
    ("a.jpg", "a.jpg"),
    ("./a.jpg", "a.jpg"),
    ("cam 0\\a.jpg", "cam 0/a.jpg"),
    (NFC, NFD),
    (NFD, NFC),
    ("IMG_1.jpg", "IMG_1.JPG"),
    ("img_1.JPEG", "IMG_1.jpg"),
    ("images/a.jpg", "a.jpg"),
    ("a.jpg", "images/a.jpg"),
    ("images/a", "images/a.webp"),
    ("a.dng", "a.jpg"),
    ("a.jpg", "a.png"),
    ("/home/you/house/images/cam0/a.jpg", "cam0/a.jpg"),
    ("D:\\captures\\house\\images\\a.jpg", "images/a.jpg"),
    ("../house/images/a.jpg", "images/a.jpg"),
    ("x/../cam0//a.jpg", "cam0/a.jpg"),
    ("left/a.jpg", "right/a.jpg"),  # the only one of that name
    ("IMG.0001", "IMG.0001.png"),
]


@pytest.mark.parametrize(("written", "file"), WRITTEN)
def test_a_name_is_matched_however_it_is_written(tmp_path, written, file):
    found = folder(tmp_path, file, "other.jpg").find([written])
    assert found.files == {written: file}
    said = found.written_differently
    assert said.startswith("one photo is written differently") == (
        written.removeprefix("./") != file and written != PurePosixPath(file).stem
    )
    assert said.endswith("another form of Unicode") == (file in (NFC, NFD))


CONFUSED = [  # names, files, and what is matched
    (["cam0/1.jpg", "cam1/1.jpg"], ["1.jpg"], {}),  # two photos of one name, one file
    (["1.jpg"], ["a/1.jpg", "b/1.jpg"], {}),  # one name, two files
    (["1"], ["1.jpg", "1.png"], {}),
    # a deleted photo is not replaced by one of its name in another folder
    (["cam0/1.jpg", "cam0/2.jpg"], ["cam0/2.jpg", "cam1/1.jpg"], {"cam0/2.jpg": "cam0/2.jpg"}),
    (["CAM0/1.jpg", "CAM0/2.jpg"], ["cam0/2.jpg", "cam1/1.jpg"], {"CAM0/2.jpg": "cam0/2.jpg"}),
    (["1.jpg", "2.jpg"], ["2.jpg", "backup/1.jpg"], {"2.jpg": "2.jpg"}),
    # nor by a file of a folder whose photos are known
    (["cam0/1.jpg", "gone/2.jpg"], ["cam0/1.jpg", "cam0/2.jpg"], {"cam0/1.jpg": "cam0/1.jpg"}),
    # nor by one that another name means
    (["cam0/1.jpg", "cam1/1.jpg"], ["cam1/1.jpg"], {"cam1/1.jpg": "cam1/1.jpg"}),
    # folders at the end of a path tell them apart
    (["D:\\x\\a\\1.jpg", "D:\\x\\b\\1.jpg"], ["a/1.jpg", "b/1.jpg"],
     {"D:\\x\\a\\1.jpg": "a/1.jpg", "D:\\x\\b\\1.jpg": "b/1.jpg"}),
    # masks and smaller copies are no photos
    (["1.jpg"], ["images/1.jpg", "images_2/1.jpg", "masks/1.jpg", "depth/1.jpg"], {"1.jpg": "images/1.jpg"}),
    (["1.jpg"], ["._1.jpg", ".hidden/1.jpg"], {}),
    (["../../etc/passwd", "\0", "", "/", "..", "a\nb.jpg"], ["a.jpg"], {}),
]  # fmt: skip


@pytest.mark.parametrize(("names", "files", "matched"), CONFUSED)
def test_photos_are_not_confused(tmp_path, names, files, matched):
    found = folder(tmp_path, *files).find(names)
    assert found.files == matched
    assert found.missing == [name for name in names if name not in matched]


def test_nothing_outside_the_folder_is_found(tmp_path):
    (tmp_path / "secret.jpg").touch()
    photos = folder(tmp_path / "capture", "a.jpg")
    assert photos.find(["../secret.jpg", str(tmp_path / "secret.jpg")]).files == {}


def test_links_that_lead_back_end(tmp_path):
    photos = folder(tmp_path, "cam0/a.jpg")
    os.symlink(tmp_path, tmp_path / "cam0" / "again", target_is_directory=True)
    assert photos.find(["A.JPG"]).files == {"A.JPG": "cam0/a.jpg"}


def test_plain_paths():
    assert [plain(name) for name in ("a\\b", "./a", "a//b/", "a/../b", "../a", "/a/./b")] == [
        "a/b", "a", "a/b", "b", "../a", "/a/b",
    ]  # fmt: skip
