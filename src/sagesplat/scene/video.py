"""Extracts frames from a video: the sharpest of each interval, without duplicates."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from msgspec import Meta
from PIL import Image

from sagesplat.core.errors import BackendUnavailable, SceneError, short
from sagesplat.core.extras import install
from sagesplat.core.limits import Count
from sagesplat.io.files import atomic_path, write_json
from sagesplat.io.typed import known_json

_GREY_WIDTH = 640  # px, of the copies that sharpness is measured on
_THUMB_WIDTH = 64  # px, of the copies that are compared for motion
_BLURRED = 0.75  # of the sharpness of both neighbours
_SAME = 1.0  # mean absolute difference, grey levels, below which the camera has not moved
MAX_PIXELS = 2**26  # of a frame; 8K video has half as many
MAX_FRAMES = 10**6  # four hours
_PACKED = 4  # times its size is what a video's packets may hold: those of a forged index overlap
# FFmpeg also knows playlists and scripts, which name other files and addresses for it to read.
_DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo"
_TURNS = {90: Image.Transpose.ROTATE_90, 180: Image.Transpose.ROTATE_180, 270: Image.Transpose.ROTATE_270}


def extract_frames(
    path: Path,
    folder: Path,
    *,
    max_frames: int = 300,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write selected frames of a video as upright JPEGs named by frame number; their paths.

    The video is divided into at most `max_frames` intervals of equal length, of at least three frames each if
    it is long enough. The sharpest frame of each is selected (largest variance of the Laplacian: Pech-Pacheco
    et al. 2000, over the variance of the frame), unless the camera has not moved since the previous one, or
    both neighbours are much sharper. Frames already extracted from the same file are reused.
    `on_frame(done, total)` counts decoded frames. Raises SceneError for an unusable file, and
    BackendUnavailable without PyAV.
    """
    try:
        from av.error import FFmpegError
    except ImportError:
        raise BackendUnavailable(f"frames of a video need PyAV; {install('sagesplat[video]')}") from None
    if not path.is_file():
        raise SceneError(f"{path}: no such file; name a video")
    stat = path.stat()
    source = _Extracted(stat.st_size, stat.st_mtime_ns, max_frames, [])
    if (kept := _finished(folder, source)) is not None:
        return kept
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("frame_*.jpg"):
        old.unlink()
    try:
        paths = [
            _write(frame, folder, i)
            for i, frame in _moving(_unblurred(_sharpest(path, max_frames, on_frame)))
        ]
    except (FFmpegError, ValueError, IndexError, MemoryError) as error:  # PyAV's own for a late stream
        reason = short(getattr(error, "strerror", None) or str(error) or "too little memory is free for it")
        raise SceneError(f"{path}: not readable as a video ({reason}); convert it to MP4") from None
    if not paths:
        raise SceneError(
            f"{path}: no frame of up to {MAX_PIXELS // 10**6} million pixels can be decoded; copy or convert "
            "the video again"
        )
    write_json(folder / "video.json", asdict(source) | {"frames": [p.name for p in paths]})
    return paths


@dataclass(frozen=True)
class _Extracted:
    """Content of video.json: of which file the frames are."""

    size: Count
    mtime_ns: int
    max_frames: int
    frames: list[Annotated[str, Meta(pattern=r"^frame_[0-9]{1,20}\.jpg\Z")]]


def _finished(folder: Path, source: _Extracted) -> list[Path] | None:
    """The frames of an earlier, finished run on the same file, if all are there."""
    made = known_json(folder / "video.json", _Extracted)
    if made is None or not made.frames or replace(made, frames=[]) != source:
        return None
    paths = [folder / name for name in made.frames]
    return paths if all(path.is_file() for path in paths) else None


class _Frame(NamedTuple):
    number: int
    frame: Any  # PyAV's
    grey: UInt8[np.ndarray, "h w"]
    score: float  # sharpness by contrast: of one camera and scene, whatever the exposure


def _sharpest(path: Path, max_frames: int, on_frame: Callable[[int, int], None] | None) -> Iterator[_Frame]:
    """The sharpest frame in each interval."""
    total = _count(path)
    windows = max(1, min(max_frames, max(total // 3, min(total, 60))))
    best: _Frame | None = None
    best_window = 0
    for i, frame in enumerate(_decode(path)):
        window = min(i * windows // max(total, 1), windows - 1)
        if best is not None and window != best_window:
            yield best
            best = None
        grey = _grey(frame)
        score = sharpness(grey) / (float(grey.var()) + 1)
        if best is None or score > best.score:
            best, best_window = _Frame(i, frame, grey, score), window
        if on_frame is not None:
            on_frame(min(i + 1, total), total)
    if best is not None:
        yield best


def _unblurred(frames: Iterator[_Frame]) -> Iterator[_Frame]:
    """Without frames that are much less sharp than both neighbours: intervals of a blurred frame alone.

    Of two such in a row both stay, so that no gap is wider than an interval.
    """
    first, last = _Frame(-1, None, np.zeros((1, 1), np.uint8), np.inf), None
    for after in frames:
        if last is not None:
            if last.score >= _BLURRED * min(first.score, after.score):
                yield last
            first = last
        last = after
    if last is not None and (first.number < 0 or last.score >= _BLURRED * first.score):
        yield last


def _moving(frames: Iterator[_Frame]) -> Iterator[tuple[int, Any]]:
    """Number and frame, without frames that look like the previous one kept."""
    last: np.ndarray | None = None
    for i, frame, grey, _ in frames:
        thumb = _thumb(grey)
        if last is None or thumb.shape != last.shape or np.abs(thumb - last).mean() >= _SAME:
            last = thumb
            yield i, frame


def _open(path: Path) -> Any:
    """The video's container, of one that is meant, which reads no other file. Raises SceneError."""
    import av
    from av.error import ArgumentError

    options = {"format_whitelist": _DEMUXERS, "protocol_whitelist": "file", "max_pixels": str(MAX_PIXELS)}
    try:
        container = av.open(str(path.absolute()), options=options)  # "a:b" would name a protocol
    except ArgumentError:
        container = None
    context = container.streams.video[0].codec_context if container and container.streams.video else None
    if container is None or context is None:  # there is none for an unknown codec
        raise SceneError(
            f"{path}: holds no video stream in MP4, MOV, MKV, WebM, AVI or MPEG; convert it to MP4, or name "
            "a folder of photos"
        )
    context.options = {"max_pixels": str(MAX_PIXELS)}
    return container


def _count(path: Path) -> int:
    """Number of frames, counted by packets: the header's count is often missing or wrong."""
    frames = nbytes = 0
    most = _PACKED * path.stat().st_size
    with _open(path) as container:
        for packet in container.demux(container.streams.video[0]):
            frames += packet.size > 0
            nbytes += packet.size
            if frames > MAX_FRAMES or nbytes > most:
                held = f"{frames:,} frames of {nbytes:,} bytes"
                raise SceneError(f"{path}: {held} or more are too many; cut or convert the video")
    return frames


def _decode(path: Path) -> Iterator[Any]:
    """The frames that can be decoded; damaged packets, and frames of too many pixels, are skipped."""
    from av.error import ArgumentError, InvalidDataError

    with _open(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        for packet in container.demux(stream):
            try:
                frames = packet.decode()
            except (InvalidDataError, ArgumentError):
                continue
            yield from frames


def _grey(frame: Any) -> UInt8[np.ndarray, "h w"]:
    width = min(frame.width, _GREY_WIDTH)
    height = max(round(frame.height * width / frame.width), 1)
    return frame.reformat(width=width, height=height, format="gray").to_ndarray()


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian, grey levels squared; 0 for images under 3 x 3 pixels."""
    if min(grey.shape) < 3:
        return 0.0
    g = grey.astype(np.float32)
    return float((g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:] - 4 * g[1:-1, 1:-1]).var())


def _thumb(grey: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "y x"]:
    """Means of square blocks of pixels, so that noise does not count as motion."""
    block = max(min(grey.shape[1] // _THUMB_WIDTH, *grey.shape), 1)
    h, w = (n // block * block for n in grey.shape)
    blocks = grey[:h, :w].reshape(h // block, block, w // block, block)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _write(frame: Any, folder: Path, index: int) -> Path:
    """One frame as an upright JPEG. The rotation in the file's metadata counts anticlockwise."""
    image = frame.to_image()
    if (turn := _TURNS.get(round(frame.rotation) % 360)) is not None:
        image = image.transpose(turn)
    path = folder / f"frame_{index:06d}.jpg"
    with atomic_path(path) as temporary:
        image.save(temporary, format="JPEG", quality=95, subsampling=0)
    return path
