"""Frames of a video: upright, sharp, evenly spread, none twice, and one line for files that are none."""

import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter

from sagesplat.core.errors import BackendUnavailable, SceneError
from sagesplat.scene import video
from sagesplat.scene.video import extract_frames, sharpness

av = pytest.importorskip("av", reason="needs PyAV (the extra `video`)")
WIDTH, HEIGHT = 128, 96


def scenery(radius: float) -> np.ndarray:
    """A wide picture with blobs of a few pixels."""
    noise = np.random.default_rng(0).normal(size=(HEIGHT, 1200))
    grey = np.clip(128 + 200 * radius * gaussian_filter(noise, radius), 0, 255)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def pan(count: int, step: int = 4, radius: float = 3) -> list[np.ndarray]:
    """Frames of a camera that moves to the right by `step` pixels each."""
    wide = scenery(radius)
    return [wide[:, i * step : i * step + WIDTH] for i in range(count)]


def write_video(path: Path, frames: list[np.ndarray]) -> Path:
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = WIDTH, HEIGHT, "yuv420p", 4_000_000
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), "rgb24")))
        container.mux(stream.encode(None))
    return path


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def numbers(paths: list[Path]) -> list[int]:
    return [int(path.stem.removeprefix("frame_")) for path in paths]


def test_frames_are_spread_evenly(tmp_path: Path) -> None:
    events: list[tuple[int, int]] = []
    video = write_video(tmp_path / "my film.mp4", pan(90))
    paths = extract_frames(video, tmp_path / "f", max_frames=10, on_frame=lambda *event: events.append(event))
    assert [number // 9 for number in numbers(paths)] == list(range(10))
    assert events == [(i + 1, 90) for i in range(90)]
    for path in paths:
        pixels = read(path)
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        expected = pan(90)[numbers([path])[0]]
        assert np.abs(pixels.astype(int) - expected).mean() < 12


def test_the_sharpest_of_each_stretch_is_taken(tmp_path: Path) -> None:
    sharp = {4, 10, 21, 28}
    frames = [f if i in sharp else gaussian_filter(f, (3, 3, 0)) for i, f in enumerate(pan(32))]
    paths = extract_frames(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", max_frames=4)
    assert set(numbers(paths)) == sharp


@pytest.mark.parametrize("count", [24, 90])
def test_every_other_frame_is_blurred(tmp_path: Path, count: int) -> None:
    """Also where the video is so short that each frame is a stretch of its own; exposure does not matter."""
    frames = [
        gaussian_filter(f, (0, 5, 0)) if i % 2 else (f * (0.5 + 0.5 * (i % 4 == 0))).astype(np.uint8)
        for i, f in enumerate(pan(count, radius=1.5))
    ]
    found = numbers(extract_frames(write_video(tmp_path / "a.mp4", frames), tmp_path / "f"))
    assert all(i % 2 == 0 for i in found)
    assert len(found) >= min(count // 2, 30)


def test_a_standing_camera_gives_one_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    still = [np.clip(pan(1)[0] + rng.normal(0, 4, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)] * 30
    paths = extract_frames(write_video(tmp_path / "a.mp4", still + pan(30)), tmp_path / "f", max_frames=20)
    assert len([i for i in numbers(paths) if i < 30]) == 1
    assert len([i for i in numbers(paths) if i > 32]) >= 9


@pytest.mark.parametrize(("matrix", "turns"), [((0, 1, -1, 0), -1), ((-1, 0, 0, -1), 2)])
def test_rotation_in_the_metadata_is_applied(tmp_path, matrix, turns):
    """Players turn clockwise by a quarter for the matrix (0, 1, -1, 0), which phones write in portrait."""
    video = write_video(tmp_path / "a.mp4", pan(6))
    upright = extract_frames(video, tmp_path / "upright")

    def entries(a: int, b: int, c: int, d: int) -> bytes:
        values = (a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
        return b"".join(value.to_bytes(4, "big", signed=True) for value in values)

    content = video.read_bytes()
    at = content.index(entries(1, 0, 0, 1), content.index(b"tkhd"))
    turned = tmp_path / "b.mp4"
    turned.write_bytes(content[:at] + entries(*matrix) + content[at + 36 :])
    paths = extract_frames(turned, tmp_path / "turned")
    assert numbers(paths) == numbers(upright)
    for a, b in zip(upright, paths, strict=True):
        expected = np.rot90(read(a), turns).astype(int)
        assert np.abs(read(b) - expected).mean() < 2


def test_frames_of_the_same_file_are_kept(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(12))
    first = extract_frames(video, tmp_path / "f", max_frames=4)
    times = [path.stat().st_mtime_ns for path in first]
    assert extract_frames(video, tmp_path / "f", max_frames=4) == first
    assert [path.stat().st_mtime_ns for path in first] == times
    again = extract_frames(video, tmp_path / "f", max_frames=2)
    assert sorted((tmp_path / "f").glob("*.jpg")) == again
    again[0].unlink()
    assert extract_frames(video, tmp_path / "f", max_frames=2) == again


def test_a_cut_video_gives_what_it_holds(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mpg", pan(60))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    paths = extract_frames(video, tmp_path / "f")
    assert 15 < len(paths) < 45


def headless(path: Path) -> None:
    content = write_video(path, pan(12)).read_bytes()
    path.write_bytes(content[: content.index(b"moov")])  # as of a recording that was broken off


@pytest.mark.parametrize(
    ("name", "fill", "message"),
    [
        ("a.mp4", lambda path: path.write_bytes(b"no video" * 99), r"as a video \(Invalid data"),
        ("a.mp4", headless, "not readable as a video"),
    ],
)
def test_a_file_that_is_no_video_is_one_line(tmp_path: Path, name: str, fill: Any, message: str) -> None:
    fill(tmp_path / name)
    with pytest.raises(SceneError, match=message) as raised:
        extract_frames(tmp_path / name, tmp_path / "f")
    assert str(raised.value).startswith(str(tmp_path / name))


def hls(path: Path) -> None:
    """A playlist in the format of HLS that names another file, in a segment that FFmpeg would read."""
    write_video(path.with_name("secret.ts"), pan(6))
    path.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nsecret.ts\n#EXT-X-ENDLIST\n")


def concat(path: Path) -> None:
    write_video(path.with_name("secret.mp4"), pan(6))
    path.write_text("ffconcat version 1.0\nfile secret.mp4\n")


@pytest.mark.parametrize(("fill", "name"), [(hls, "a.m3u8"), (hls, "a.mp4"), (concat, "a.mkv")])
def test_scripts_that_read_other_files_are_refused(tmp_path: Path, fill: Any, name: str) -> None:
    fill(tmp_path / name)
    with pytest.raises(SceneError, match=r"holds no video stream in MP4|not readable as a video"):
        extract_frames(tmp_path / name, tmp_path / "f")
    assert not list((tmp_path / "f").glob("*.jpg"))


def test_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "secret.mp4", pan(6)).rename(tmp_path / "concat:secret.mp4")
    assert len(extract_frames(Path("concat:secret.mp4"), tmp_path / "f")) == 6


def frames_of(path: Path, pixels: np.ndarray, count: int = 3) -> Path:
    """A video whose first frame is small; the others are PNG files that a decoder takes as they are."""
    file = path.with_suffix(".png")
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "rgb24"
        for i in range(count):
            Image.fromarray(pixels if i else pan(1)[0]).save(file, compress_level=1)
            packet = av.Packet(file.read_bytes())
            packet.stream, packet.pts, packet.dts, packet.time_base = stream, i, i, Fraction(1, 25)
            container.mux(packet)
    return path


def test_frames_of_too_many_pixels_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = frames_of(tmp_path / "a.mov", np.zeros((600, 800, 3), np.uint8))
    assert len(extract_frames(large, tmp_path / "f")) == 2
    monkeypatch.setattr(video, "MAX_PIXELS", 100_000)
    (kept,) = extract_frames(large, tmp_path / "g")
    assert read(kept).shape == (HEIGHT, WIDTH, 3)
    monkeypatch.setattr(video, "MAX_PIXELS", 1000)
    with pytest.raises(SceneError, match="no frame of up to"):
        extract_frames(large, tmp_path / "h")


@pytest.mark.parametrize("content", ["{", '{"frames": 3}', "OWN"])
def test_a_list_of_frames_from_elsewhere_is_not_believed(tmp_path: Path, content: str) -> None:
    film = write_video(tmp_path / "a.mp4", pan(6))
    first = extract_frames(film, tmp_path / "f")
    listed = json.loads((tmp_path / "f" / "video.json").read_text())
    if content == "OWN":
        content = json.dumps(listed | {"frames": ["../a.mp4"]})
    (tmp_path / "f" / "video.json").write_text(content)
    assert extract_frames(film, tmp_path / "f") == first
    assert json.loads((tmp_path / "f" / "video.json").read_text()) == listed


def test_without_pyav(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av.error", None)
    with pytest.raises(BackendUnavailable, match=r"PyAV; .*pip install 'sagesplat\[video\]'"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "f")


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.floats(0.5, 3))
def test_blur_lowers_sharpness(seed: int, sigma: float) -> None:
    grey = np.random.default_rng(seed).integers(0, 256, (20, 24)).astype(np.uint8)
    assert sharpness(gaussian_filter(grey, sigma)) < sharpness(grey)
    assert sharpness(np.full((9, 9), 7, np.uint8)) == 0
    assert sharpness(grey[:2]) == 0


def test_a_video_of_too_many_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = write_video(tmp_path / "a.mp4", pan(12))
    monkeypatch.setattr(video, "MAX_FRAMES", 11)
    with pytest.raises(SceneError, match=r"a\.mp4: 12 frames of .* too many; cut or convert"):
        extract_frames(film, tmp_path / "f")


def test_packets_that_hold_more_than_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where an index names the same bytes again and again."""
    film = write_video(tmp_path / "a.mp4", pan(12))
    monkeypatch.setattr(video, "_PACKED", 0.5)
    with pytest.raises(SceneError, match="bytes or more are too many"):
        extract_frames(film, tmp_path / "f")


def test_long_videos_keep_three_frames_to_choose_from(tmp_path: Path) -> None:
    assert len(extract_frames(write_video(tmp_path / "a.mp4", pan(240)), tmp_path / "a")) == 80
    assert len(extract_frames(write_video(tmp_path / "b.mp4", pan(40)), tmp_path / "b")) == 40
