"""Every reader of bytes that may come from somebody else, by subject: the one list of them.

`tests/fuzz/foreign.py` finds the functions of the package that read, and a test fails where one of them is
neither reached by a reader of this list nor an exception with a reason.
"""

from tests.fuzz.hostile import Reader
from tests.fuzz.readers import captures, downloads, foreign_splats, networks, records, requests, splats

READERS: tuple[Reader, ...] = (
    *captures.READERS,
    *splats.READERS,
    *foreign_splats.READERS,
    *records.READERS,
    *networks.READERS,
    *downloads.READERS,
    *requests.READERS,
)
