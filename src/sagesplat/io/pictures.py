"""The one place that opens pictures: named formats only, and limits that are checked before decoding.

Pillow by itself opens some sixty formats, and starts Ghostscript for PostScript, whatever the file's name is.
"""

import importlib
import logging
import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from io import BufferedReader, BytesIO
from pathlib import Path

from PIL import Image, ImageFile, UnidentifiedImageError, features

from sagesplat.core.errors import short
from sagesplat.core.extras import install
from sagesplat.io.files import regular

PHOTO_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "AVIF", "HEIF")
FREE_PIXELS = 2**24  # a picture may have as many, however small its file is
MAX_PIXELS = 2**28  # phones take 200 megapixels
# Photos hold 1 to 16 pixels per byte; a JPEG that a camera took in the dark has 64.
PIXELS_PER_BYTE = 64
_HEAD = 256  # bytes that tell formats apart
_JUNK = 4096  # bytes between a JPEG's segments
_SEGMENTS, _EXIF_SEGMENTS, _SCANS = 4096, 16, 32  # of a JPEG; photos have tens, 1 and 10
_CHUNKS, _BYTES_PER_CHUNK = 4096, 256  # of a PNG: so many, and one more for each such part of the file
_PACKED_CHUNKS = 16  # of a PNG; each may hold a megabyte
_TAGS, _RATIONALS = 4096, 1024  # of a TIFF; Pillow takes 5 us for each rational number
_EXIF_TAG = 34665
# Of TIFFs that hold photos. Others are faxes, of whose every damaged row libtiff prints a line, or obsolete.
_COMPRESSIONS = (
    *("raw", "packbits", "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate"),
    *("jpeg", "lzma", "zstd", "webp"),
)
_PNG_CHANNELS = {2: 3, 4: 2, 6: 4}  # by the colour type; 1 otherwise
_DEFLATE = 1032  # times its size is all that a deflate stream can hold
_LOCK = threading.Lock()
logging.getLogger("PIL").addHandler(logging.NullHandler())  # or Pillow's errors reach the terminal

_PLUGINS = {"JPEG": "Jpeg", "PNG": "Png", "TIFF": "Tiff", "WEBP": "WebP", "BMP": "Bmp", "AVIF": "Avif"}
_MAGIC = (
    (b"\xff\xd8\xff", "JPEG"),
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"II*\0", "TIFF"),
    (b"MM\0*", "TIFF"),
    (b"II+\0", "TIFF"),
    (b"MM\0+", "TIFF"),
    (b"BM", "BMP"),
    # Known in order to be named, never opened.
    (b"%!", "PostScript"),
    (b"\xc5\xd0\xd3\xc6", "PostScript"),
    (b"%PDF", "PDF"),
    (b"GIF8", "GIF"),
    (b"DDS ", "DDS"),
    (b"SIMPLE  =", "FITS"),
    (b"8BPS", "Photoshop"),
    (b"\xd7\xcd\xc6\x9a", "WMF"),
    (b"v/1\x01", "OpenEXR"),
    (b"#?", "Radiance HDR"),
    (b"\0\0\0\x0cjP", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"\0\0\0\x0cJXL", "JPEG XL"),
    (b"\xff\x0a", "JPEG XL"),
    (b"FUJIFILM", "camera raw"),
    (b"PK\x03\x04", "ZIP"),
    (b"\x1a\x45\xdf\xa3", "video"),
    (b"<", "SVG, XML or HTML"),
    *((b"P%d%c" % (i, space), "PPM") for i in range(1, 8) for space in b" \n\r\t"),
)


class PictureError(Exception):
    """Why a picture cannot be used, and what to do about it: text for a message of one line."""

    def __init__(self, reason: str, cure: str = ""):
        super().__init__(f"{reason}; {cure}" if cure else reason)
        self.reason, self.cure = reason, cure


@contextmanager
def open_picture(
    source: Path | bytes,
    formats: Sequence[str] = PHOTO_FORMATS,
    *,
    free: int = FREE_PIXELS,
    decodes: bool = True,
) -> Iterator[ImageFile.ImageFile]:
    """A picture whose header has been read and whose pixels have not; they are decoded in the block.

    Args:
        source: The file, or the content of a WebP file. The content tells the format, not the name.
        formats: Those of `PHOTO_FORMATS` that are accepted.
        free: Number of pixels that any file may have. A larger picture may have `PIXELS_PER_BYTE` times its
            file's size, and never more than `MAX_PIXELS`.
        decodes: False where the block looks at the header only: then the pixels' cost is not checked.

    Raises:
        PictureError: If the file is missing, of another format, too large or damaged; also for whatever else
            is raised in the block, so it should hold nothing but the decoding. An empty `cure` means that the
            file is missing or damaged.
    """
    try:
        with _without_warnings(), _opened_source(source) as file:
            kind = _checked_format(file, formats)
            nbytes = len(source) if isinstance(source, bytes) else source.stat().st_size
            _check_metadata(file, kind, nbytes, decodes)
            with _opened(file, kind) as image:
                _check_pixels(image.size, nbytes, free)
                yield image
    except PictureError:
        raise
    except MemoryError:
        raise PictureError("too little memory is free for it", "close other programs") from None
    except UnidentifiedImageError:
        raise PictureError("its header is damaged") from None
    except Exception as error:  # decoders raise errors of many kinds for damaged files
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise PictureError(short(reason.strip() or type(error).__name__)) from None


def _without_warnings() -> AbstractContextManager[None]:
    """Silences Pillow about large pictures and invalid metadata; Python allows that in one thread only."""
    if threading.current_thread() is not threading.main_thread():
        return nullcontext()
    return warnings.catch_warnings(action="ignore")


def _opened_source(source: Path | bytes) -> BufferedReader:
    return BufferedReader(BytesIO(source)) if isinstance(source, bytes) else regular(source).open("rb")  # type: ignore[arg-type]


def _checked_format(file: BufferedReader, formats: Sequence[str]) -> str:
    """The format by the file's first bytes, ready to be opened. PictureError unless it is in `formats`."""
    head = file.read(_HEAD)
    kind = _format(head)
    if kind is None:
        raise PictureError("it is no picture of a known format" if head else "it is empty")
    if kind not in formats:
        cure = (
            "convert it to JPEG or PNG" if "JPEG" in formats else f"export it again as {' or '.join(formats)}"
        )
        raise PictureError(f"its content is {kind}", cure)
    if kind == "HEIF":
        _register_heif()
    else:
        # Or Pillow would import all of its plugins to find this one.
        importlib.import_module(f"PIL.{_PLUGINS[kind]}ImagePlugin")
    if kind == "AVIF" and not features.check("avif"):
        raise PictureError("this Pillow cannot read AVIF", install("pillow", "--upgrade"))
    return kind


def _format(head: bytes) -> str | None:
    """The name of the format that begins so."""
    if head[:4] == b"RIFF":
        return {b"WEBP": "WEBP", b"AVI ": "video"}.get(head[8:12])
    if head[4:8] == b"ftyp":
        brands = head[8 : int.from_bytes(head[:4], "big")]
        if b"avif" in brands or b"avis" in brands:
            return "AVIF"
        if any(brand in brands for brand in (b"mif1", b"msf1", b"heic", b"heix", b"hevc", b"hevx", b"heim")):
            return "HEIF"
        return "camera raw" if brands[:3] == b"crx" else "video"
    return next((name for magic, name in _MAGIC if head.startswith(magic)), None)


def _register_heif() -> None:
    try:
        import pi_heif
    except ImportError:
        raise PictureError("HEIC needs an extra", install("sagesplat[heic]")) from None
    if "HEIF" not in Image.OPEN:
        pi_heif.register_heif_opener()


@contextmanager
def _opened(file: BufferedReader, kind: str) -> Iterator[ImageFile.ImageFile]:
    with _LOCK:  # Pillow's own limit is one for all: 89 megapixels warn, twice as many fail
        default = Image.MAX_IMAGE_PIXELS
        Image.MAX_IMAGE_PIXELS = None
        try:
            image = Image.open(file, formats=[kind])
        finally:
            Image.MAX_IMAGE_PIXELS = default
    with image:
        compression = image.info.get("compression", "raw")
        if kind == "TIFF" and compression not in _COMPRESSIONS:
            raise PictureError(f"a TIFF packed as {short(compression)}", "convert it to PNG")
        yield image


def _check_pixels(size: tuple[int, int], nbytes: int, free: int) -> None:
    """PictureError for more pixels than a picture may have, or than an honest one in `nbytes` bytes has."""
    width, height = size
    pixels, said = width * height, f"{width} x {height} pixels"
    if pixels > MAX_PIXELS:
        raise PictureError(f"{said}, more than {MAX_PIXELS // 10**6} million", "make it smaller")
    if pixels > max(free, PIXELS_PER_BYTE * nbytes):
        raise PictureError(f"{said} in {nbytes:,} bytes, more than photos have", "make it smaller")


def _check_metadata(file: BufferedReader, kind: str, nbytes: int, decodes: bool) -> None:
    """PictureError for metadata over which Pillow would take long or much memory."""
    if kind == "PNG":
        _check_png(file, nbytes, decodes)
    if kind == "TIFF":
        _check_tiff(file)
    if kind == "JPEG":
        in_one_pass = _check_jpeg(file)
        if decodes and not in_one_pass and file.read().count(b"\xff\xda\x00") >= _SCANS:
            raise PictureError("a JPEG of too many scans", "save it again")


def _check_jpeg(file: BufferedReader) -> bool:
    """Read segments up to the first scan; whether it is the only one. PictureError for too many segments."""
    file.seek(2)
    junk = exif = components = 0
    progressive = False
    for _ in range(_SEGMENTS):
        while (byte := file.read(1)) != b"\xff":
            junk += 1
            if not byte or junk > _JUNK:
                raise PictureError("its segments are damaged")
        while (byte := file.read(1)) == b"\xff":
            junk += 1
            if junk > _JUNK:
                raise PictureError("its segments are damaged")
        if byte in b"\x00\x01\xd0\xd1\xd2\xd3\xd4\xd5\xd6\xd7":
            continue
        head = file.read(8)
        if byte == b"\xda":
            return not progressive and head[2:3] == bytes([components])
        if 0xC0 <= byte[0] <= 0xCF and byte not in b"\xc4\xc8\xcc":  # a frame header
            progressive, components = byte in b"\xc2\xc6\xca\xce", head[7] if len(head) == 8 else 0
        exif += byte == b"\xe1" and head[2:] == b"Exif\0\0"
        if len(head) < 2 or exif > _EXIF_SEGMENTS:
            raise PictureError("its segments are damaged")
        file.seek(int.from_bytes(head[:2], "big") - len(head), 1)
    raise PictureError("its metadata has too many segments", "save it again")


def _check_png(file: BufferedReader, nbytes: int, to_the_end: bool) -> None:
    """PictureError for chunks without end, many megabytes of packed texts, pixels that cannot be there."""
    at, packed = 8, 0
    with open(file.name, "rb", buffering=0) as chunks:  # most are thousands of bytes apart
        head = chunks.read(26)
        if head[12:16] == b"IHDR" and len(head) == 26:
            width, height, depth, color = struct.unpack(">IIBB", head[16:])
            if width * height * depth * _PNG_CHANNELS.get(color, 1) > 8 * _DEFLATE * nbytes:
                raise PictureError(f"{width} x {height} pixels, more than fit into {nbytes:,} bytes")
        for _ in range(_CHUNKS + nbytes // _BYTES_PER_CHUNK):
            chunks.seek(at)
            head = chunks.read(8)
            kind = head[4:]
            packed += kind in (b"zTXt", b"iTXt")
            if packed > _PACKED_CHUNKS:
                break
            if len(head) < 8 or kind == b"IEND" or (kind == b"IDAT" and not to_the_end):
                return
            at += int.from_bytes(head[:4], "big") + 12
    raise PictureError("its metadata has too many chunks", "save it again")


def _check_tiff(file: BufferedReader) -> None:
    """PictureError for more tags, or rational numbers in one, than photos have."""
    file.seek(0)
    head = file.read(16)
    big = head[2:4] in (b"+\0", b"\0+")
    order, word, value, at = "<" if head[:1] == b"I" else ">", *("QQ" if big else "HI"), 8 if big else 4
    number, entry = struct.Struct(order + word), struct.Struct(f"{order}HH{value}{value}")
    directories = [struct.unpack_from(order + value, head, at)[0]]
    for at in directories:
        file.seek(min(at, 2**62))
        count = number.unpack(file.read(number.size))[0]
        if count > _TAGS:
            raise PictureError("its metadata has too many tags", "save it again")
        content = file.read(count * entry.size)
        for start in range(0, len(content) - entry.size + 1, entry.size):
            tag, kind, values, offset = entry.unpack_from(content, start)
            if kind in (5, 10) and values > _RATIONALS:
                raise PictureError("its metadata has too many numbers", "save it again")
            if tag == _EXIF_TAG and len(directories) == 1:
                directories.append(offset)
