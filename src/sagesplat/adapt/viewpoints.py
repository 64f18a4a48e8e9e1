"""Viewpoints drawn from a declared distribution, so that what is measured at some says something of others.

The rule, for each viewpoint by itself:

1. Take one of the base cameras, and one of its nearest neighbours among them (position over extent plus view
   direction). Base cameras are those of the training and calibration photos, or those of a file.
2. Interpolate between the two by a share that is uniform in [0, 1]: positions linearly, rotations along the
   shortest arc. Intrinsics and image size are the first one's.
3. Move it by up to `shift` times the extent along each axis, turn it by up to `turn` radians about each axis,
   both uniform.
4. Draw again where it lies in something: where the closest point of the capture is less than half as far as
   from both cameras. After 50 draws the first camera itself is taken.

All draws are independent of each other, so those that nothing is fitted to are exchangeable with those of a
visitor who moves as the rule says.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from sagesplat.core.limits import Count, Seed, Share
from sagesplat.io.files import read_json, write_json
from sagesplat.io.typed import check_limits, convert_as, read_json_as, refused
from sagesplat.scene.cameras import VIEWPOINTS, ViewpointsFile
from sagesplat.scene.nerfstudio import Poses
from sagesplat.scene.scene import Camera, Scene

SETS = ("fit", "bias", "calibration")  # what they are for; none of them is used for another
LARGEST_TURN = 3.1416  # half a turn, as `SampleConfig.turn`
_TRIES = 50
_CLEAR = 0.5  # of the way to the closest point that its cameras have


@dataclass(frozen=True)
class Rule:
    """The distribution that viewpoints are drawn from (the module's text)."""

    seed: Seed = 0
    neighbours: Count = 4  # nearest cameras that one is drawn from; 0: no interpolation
    shift: Share = 0.03  # share of the scene's extent
    turn: Annotated[float, Meta(ge=0, le=LARGEST_TURN)] = 0.05  # radians


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Drawn viewpoints, and how they were drawn."""

    rule: Rule
    source: str  # "capture", or the name of the file with the base cameras
    cameras: tuple[Camera, ...]
    sets: tuple[str, ...]  # one of SETS for each

    def rows(self, *names: str) -> np.ndarray:
        """Rows of the viewpoints in these sets, ascending."""
        return np.flatnonzero(np.isin(self.sets, names))


def draw(
    scene: Scene, base: Sequence[Camera], rule: Rule, counts: dict[str, int], source: str = "capture"
) -> Viewpoints:
    """Draw viewpoints for each of SETS.

    A set's draws depend on the rule, the base cameras and their own number only: more of one set leave the
    others as they are, and begin with the same ones.

    Args:
        scene: The capture: its extent and points.
        base: At least one camera.
        rule: The distribution.
        counts: Viewpoints by set.
        source: Where the base cameras are from, for the record.

    Returns:
        The viewpoints, in the order of `counts`.

    Raises:
        RunError: For a rule that cannot be followed.
    """
    check_limits(rule, "sample.")
    sampler = _Sampler(scene, base, rule)
    cameras, sets = [], []
    for name, count in counts.items():
        of_set = int.from_bytes(name.encode()[:8], "big")  # so that sets differ
        for number in range(count):
            rng = np.random.default_rng([rule.seed, of_set, number])
            cameras.append(sampler.draw(rng))
            sets.append(name)
    return Viewpoints(rule, source, tuple(cameras), tuple(sets))


def capture_cameras(scene: Scene) -> list[Camera]:
    """The cameras of training and calibration photos: test photos stay out of everything."""
    return [scene.views[row].camera.neutral for row in (*scene.train_ids, *scene.calibration_ids)]


class _Sampler:
    """Draws one viewpoint after the other."""

    def __init__(self, scene: Scene, base: Sequence[Camera], rule: Rule):
        self.base, self.rule = base, rule
        self.position = np.stack([camera.position for camera in base]).astype(np.float64)
        self.rotation = np.stack([camera.w2c[:3, :3].T for camera in base]).astype(np.float64)
        points = scene.points.xyz
        self.points = KDTree(points) if len(points) else None
        self.free = self._free(self.position)
        self.extent = scene.scale
        apart = np.linalg.norm(self.position[:, None] - self.position, axis=2) / self.extent
        direction = self.rotation[:, :, 2]
        apart += np.linalg.norm(direction[:, None] - direction, axis=2)
        self.near = np.argsort(apart, axis=1, kind="stable")[:, 1 : rule.neighbours + 1]

    def _free(self, positions: np.ndarray) -> np.ndarray:
        """Distance from positions to the closest point of the capture; inf without points."""
        if self.points is None:
            return np.full(len(positions), np.inf)
        return np.asarray(self.points.query(positions)[0])

    def draw(self, rng: np.random.Generator) -> Camera:
        one = int(rng.integers(len(self.base)))
        for _ in range(_TRIES):
            one = int(rng.integers(len(self.base)))
            other = int(rng.choice(self.near[one])) if self.near.shape[1] else one
            share = rng.uniform()
            position = (1 - share) * self.position[one] + share * self.position[other]
            position += self.extent * rng.uniform(-self.rule.shift, self.rule.shift, 3)
            turned = Slerp([0, 1], Rotation.from_matrix(self.rotation[[one, other]]))(share)
            turned *= Rotation.from_rotvec(rng.uniform(-self.rule.turn, self.rule.turn, 3))
            free = self._free(position[None])[0]
            if not free < _CLEAR * min(self.free[one], self.free[other]):
                w2c = np.eye(4)
                w2c[:3, :3] = turned.as_matrix().T
                w2c[:3, 3] = -w2c[:3, :3] @ position
                return replace(self.base[one], w2c=w2c.astype(np.float32))
        return self.base[one]


def write_viewpoints(path: Path, drawn: Viewpoints) -> None:
    """viewpoints.json: the rule, and every viewpoint with its set."""
    entries = [
        {
            "set": name,
            "w2c": camera.w2c.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "background": list(camera.background),
        }
        for camera, name in zip(drawn.cameras, drawn.sets, strict=True)
    ]
    head = {"format": VIEWPOINTS, "version": 1, "rule": asdict(drawn.rule), "cameras": drawn.source}
    write_json(path, {**head, "viewpoints": entries})


@dataclass(frozen=True, kw_only=True)
class _Drawn(ViewpointsFile):
    rule: Rule
    cameras: str


def read_viewpoints(path: Path) -> Viewpoints:
    """What `write_viewpoints` wrote; DataError where the content cannot be used."""
    what, cure = "a file of viewpoints", "delete it and run `sagesplat sample` again"
    made = read_json_as(path, _Drawn, what, cure)
    with refused(path, what, cure):
        cameras = tuple(entry.camera() for entry in made.viewpoints)
        sets = tuple(entry.set for entry in made.viewpoints)
        if unknown := set(sets) - set(SETS):
            raise ValueError(f"unknown set {unknown.pop()!r}")
    return Viewpoints(made.rule, made.cameras, cameras, sets)


def read_cameras(path: Path, like: Camera) -> list[Camera]:
    """Base cameras from a file: a viewpoints.json, or the frames of a transforms.json (poses only).

    Args:
        path: The file. Frames need a `transform_matrix` (camera to world, OpenGL axes, the capture's world).
        like: Its intrinsics and image size are those of all frames.

    Returns:
        At least one camera.

    Raises:
        DataError: Where the file cannot be used.
    """
    cure = "give a viewpoints.json, or a transforms.json whose frames have a transform_matrix"
    document = read_json(path, cure)
    with refused(path, "a list of viewpoints", cure):
        if isinstance(document, dict) and document.get("format") == VIEWPOINTS:
            cameras = [entry.camera() for entry in convert_as(document, ViewpointsFile).viewpoints]
        else:
            poses = [frame.world_to_camera() for frame in convert_as(document, Poses).frames]
            cameras = [replace(like.neutral, w2c=w2c.astype(np.float32)) for w2c in poses]
        if not cameras:
            raise ValueError("no viewpoints")
    return cameras
