"""Reads untrusted files of torch.save: tensors alone, and memory bounded by the file's size."""

import mmap
from typing import IO, Any
from zipfile import ZIP_STORED, ZipFile, is_zipfile

# before it torch says how to read the file nevertheless, and run what is in it
_REFUSED = "WeightsUnpickler error: "


def read_tensors(file: IO[bytes]) -> Any:
    """What torch.save wrote to an open file, if nothing but tensors and plain values is in it.

    Raises an exception of any kind for another file, or a damaged one: torch has many.
    """
    import torch

    if file.read(2) == b"PK" or is_zipfile(file):
        _check_members(file)
    # Of a memory map no more can be read than is there: a file would allocate what a pickle announces.
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        try:
            return torch.load(content, map_location="cpu", weights_only=True)  # type: ignore
        except Exception as error:
            _, says, reason = str(error).partition(_REFUSED)
            if not says:
                raise
            raise ValueError(reason.partition("\n")[0]) from None


def _check_members(file: IO[bytes]) -> None:
    """ValueError for members that are compressed, or overlap: they hold more than the file does."""
    with ZipFile(file) as archive:
        infos = archive.infolist()
    if any(info.compress_type != ZIP_STORED or info.file_size != info.compress_size for info in infos):
        raise ValueError("compressed")
    file.seek(0, 2)
    if sum(info.file_size for info in infos) > file.tell():
        raise ValueError("its members are larger than the file")
