"""Splat formats; a new one is a file with a `READER` or `WRITER`, or both, and a line here for each."""

from sagesplat.formats import (
    compressed_ply,
    dotsplat,
    gltf,
    gltf_write,
    lod_meta,
    lod_meta_write,
    ply,
    rad_write,
    sog,
    sog_write,
    spz,
)
from sagesplat.formats.splat import SplatReader, SplatWriter

READERS: dict[str, SplatReader] = {
    "streamed SOG": lod_meta.READER,  # before SOG: of a folder with both, this is read
    "SOG": sog.READER,
    "compressed PLY": compressed_ply.READER,  # before PLY, which begins with the same bytes
    "PLY": ply.READER,
    "SPZ": spz.READER,
    "glTF": gltf.READER,
    ".splat": dotsplat.READER,
}
"""By the name that people call the format; the first that recognises a file reads it."""

WRITERS: dict[str, SplatWriter] = {
    ".ply": ply.WRITER,
    ".spz": spz.WRITER,
    ".sog": sog_write.WRITER,
    ".glb": gltf_write.WRITER,
    ".compressed.ply": compressed_ply.WRITER,
    ".splat": dotsplat.WRITER,
    ".rad": rad_write.WRITER,
    ".ssog": lod_meta_write.SSOG_WRITER,
    lod_meta.LOD_META: lod_meta_write.WRITER,
}
"""By the suffix of files, the longest that fits, or their whole name."""
