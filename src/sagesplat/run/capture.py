"""The capture of a run: what scene.json says of it, and whether its photos are still the same."""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from sagesplat.core.config import SceneConfig
from sagesplat.core.errors import RunError, short
from sagesplat.core.geometry import NO_OFFSET, Position
from sagesplat.io.files import write_json
from sagesplat.io.typed import convert_as, known_json, read_json_as
from sagesplat.run.records import file_hash
from sagesplat.scene import load_scene
from sagesplat.scene.scene import Scene, Vignetting
from sagesplat.scene.vignetting_fit import with_vignetting

_CURE = "delete it, and run `sagesplat run SCENE RUN` again with the same settings"


@dataclass(frozen=True)
class Capture:
    """What scene.json says of the capture that a run is made from."""

    path: Path
    settings: dict[str, Any]  # of `SceneConfig`: how it is read; none for a stored scene
    fingerprint: str
    photos: dict[str, str]  # SHA-256 by name
    vignetting: Vignetting | None = None  # that was found in the photos, where it was looked for
    offset: Position = NO_OFFSET  # of an adopted splat that was far from its origin (`Scene.offset`)

    def __post_init__(self) -> None:
        convert_as(self.settings, SceneConfig)
        if unknown := sorted(self.settings.keys() - {field.name for field in fields(SceneConfig)}):
            raise ValueError(f"setting {short(unknown[0])} is not known")

    def load(self) -> Scene:
        """The capture, whose vignetting is not estimated again. Raises SceneError."""
        settings: dict[str, Any] = {**self.settings, "vignetting": False}
        scene = load_scene(self.path, **settings)
        scene = scene if any(scene.offset) else replace(scene, offset=self.offset)
        return with_vignetting(scene, self.vignetting) if self.vignetting else scene


def read_capture(path: Path) -> Capture:
    """The capture that a scene.json names; RunError for anything else."""
    return read_json_as(path, Capture, "the scene of a run", _CURE, RunError)


def fingerprint(scene: Scene) -> str:
    """Changes when the poses, the points or the set of photos do."""
    digest = hashlib.sha256()
    for view in scene.views:
        size = view.image_path.stat().st_size
        digest.update(f"{view.name} {size} {view.camera.width} {view.camera.height}".encode())
        digest.update(view.camera.w2c.tobytes() + view.camera.K.tobytes())
        if any(view.camera.background):
            digest.update(bytes(view.camera.background))
        if view.vignetting:
            digest.update(repr(view.vignetting).encode())
    digest.update(scene.points.xyz.tobytes())
    if any(scene.offset):
        digest.update(repr(scene.offset).encode())
    if scene.test_names is not None:
        digest.update("\n".join(sorted(scene.test_names)).encode())
    if scene.calibration_names is not None:
        digest.update("\n".join(["", *sorted(scene.calibration_names)]).encode())
    return digest.hexdigest()


class Hashes:
    """SHA-256 of files by name. Those that changed neither in size nor in time are not read again.

    A file that was copied or touched has the same hash, one that was replaced has another, whatever its size.
    """

    def __init__(self, kept: Path, files: Mapping[str, Path]) -> None:
        """`kept`: where `keep` wrote what was known of the files before; it may be missing."""
        self._path, self._known = kept, known_json(kept, dict) or {}
        self._found = {name: _state_of(path, self._known.get(name)) for name, path in files.items()}

    @property
    def sha256(self) -> dict[str, str]:
        """By name."""
        return {name: state[3] for name, state in self._found.items()}

    @property
    def digest(self) -> str:
        """One SHA-256 of all names and hashes."""
        return hashlib.sha256(json.dumps(sorted(self.sha256.items())).encode()).hexdigest()

    def keep(self, path: Path | None = None) -> None:
        """Write what is known now, if it is news; where that cannot be, files are read again next time."""
        if path is not None or self._found != self._known:
            with suppress(RunError, OSError):
                write_json(path or self._path, self._found)

    def of(self, names: set[str]) -> "Hashes":
        """Those of some of the files."""
        part = Hashes(self._path, {})
        part._found = {name: state for name, state in self._found.items() if name in names}
        return part


def photo_hashes(kept: Path, scene: Scene) -> Hashes:
    """The hashes of a scene's photos."""
    return Hashes(kept, {view.name: view.image_path for view in scene.views})


def check_photos(scene: Scene, begun: Mapping[str, str], now: Mapping[str, str]) -> None:
    """RunError, naming a photo, where the photos are not those that a run began with."""
    for view in scene.views:
        if begun.get(view.name) != now[view.name]:
            raise RunError(
                f"{view.image_path}: not the photo that this run began with; put that one back, or choose "
                "another run folder"
            )


def _state_of(path: Path, known: Any) -> list[Any]:
    """Bytes of a file, when its content and its status changed (ns), and its SHA-256."""
    status = path.stat()
    now = [status.st_size, status.st_mtime_ns, status.st_ctime_ns]
    usable = isinstance(known, list) and known[:3] == now and len(known) == 4 and isinstance(known[3], str)
    return known if usable else [*now, file_hash(path)]
