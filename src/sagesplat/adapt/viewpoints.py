"""Viewpoints drawn from a declared distribution, so that what is measured at some says something of others.

The rule, for each viewpoint by itself:

1. Take one of the base cameras: those of the training and calibration photos, or those of a file.
2. Choose a place, by the rule's shares:
   - "path": between it and one of its nearest neighbours (position over extent plus view direction), by a
     share that is uniform in [0, 1]: positions linearly, rotations along the shortest arc. Moved by up to
     `shift` times the extent along each axis, turned by up to `turn` radians about each axis, both uniform.
   - "walk": among the cameras: uniform in their box, grown by a tenth on every side, at the height of one of
     them, give or take a tenth of the extent; looking at a point of the inner half of the capture.
   - "back": behind it, by a uniform share of the median depth of what it sees.
   A path or walk that lies in something is drawn again: where the closest point of the capture is less than
   half as far as from both cameras, or as from all but a tenth of the cameras. After 50 draws the camera
   itself is taken.
3. Choose a screen: its focal length in pixels is `s` times the camera's, log-uniform in `screens`, its size
   as well. Half of them have another shape and lens: the ratio of the sides is log-uniform from portrait to
   landscape phones, the shorter side log-uniform from that of a picture of the same area to one that takes
   in `fov` degrees. None has more than three times the pixels of a photo on the sharpest screen: `s` is then
   smaller.

All draws are independent of each other, so those that nothing is fitted to are exchangeable with those of a
visitor who moves as the rule says.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from sagesplat.adapt.free_poses import looking
from sagesplat.core.errors import RunError
from sagesplat.core.geometry import NO_OFFSET, Position, less_offset
from sagesplat.core.limits import Count, Fov, Positive, Screen, Seed, Share
from sagesplat.io.files import read_json, write_json
from sagesplat.io.typed import check_limits, convert_as, read_json_as, refused
from sagesplat.scene.cameras import MOST_PIXELS, VIEWPOINTS, ViewpointsFile
from sagesplat.scene.nerfstudio import Poses
from sagesplat.scene.scene import Camera, Scene

SETS = ("fit", "bias", "calibration")  # what they are for; none of them is used for another
LARGEST_TURN = 3.1416  # half a turn, as `SampleConfig.turn`
PLACES = ("path", "walk", "back")
_TRIES = 50
_CLEAR = 0.5  # of the way to the closest point that its cameras have
_CROWDED = 0.1  # of the cameras are closer to a point than that of a walk
_GROWN = 0.1  # of the box of the cameras, that a walk may leave it by
_RISE = 0.1  # of the extent, from the height of a camera
_SHAPED = 0.5  # of the viewpoints have another shape than the photos
LONGEST = 20 / 9  # of the sides of a picture, the longer over the shorter
_RATIOS = np.log([9 / 20, LONGEST])  # of width to height
_MORE_PIXELS = 3  # that a picture may have than a photo on the sharpest screen


@dataclass(frozen=True)
class Rule:
    """The distribution that viewpoints are drawn from (the module's text)."""

    seed: Seed = 0
    neighbours: Count = 4  # nearest cameras that one is drawn from; 0: no interpolation
    shift: Share = 0.03  # share of the scene's extent
    turn: Annotated[float, Meta(ge=0, le=LARGEST_TURN)] = 0.05  # radians
    screens: tuple[Screen, Screen] = (0.5, 2.0)  # focal length in pixels over the camera's, from and to
    places: tuple[Share, Share, Share] = (0.4, 0.4, 0.2)  # of PLACES
    fov: Fov = 100.0  # widest lens: degrees of the picture's shorter side; photos may be wider


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Drawn viewpoints, and how they were drawn."""

    rule: Rule
    source: str  # "capture", or the name of the file with the base cameras
    focal: float  # of the base cameras, median, pixels
    cameras: tuple[Camera, ...]
    sets: tuple[str, ...]  # one of SETS for each
    offset: Position = NO_OFFSET  # `Scene.offset`

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
    check_rule(rule)
    pixels, (low, high) = max(camera.width * camera.height for camera in base), rule.screens
    if pixels * high**2 > MOST_PIXELS:
        most = math.floor(100 * math.sqrt(MOST_PIXELS / pixels)) / 100
        raise RunError(
            f"--sample.screens {low:g} {high:g}: pictures of {pixels * high**2 / 1e6:,.0f} megapixels, and "
            f"at most {MOST_PIXELS / 1e6:,.0f} are drawn; end at {most:g} or below"
        )
    sampler = _Sampler(scene, base, rule)
    cameras, sets = [], []
    for name, count in counts.items():
        of_set = int.from_bytes(name.encode()[:8], "big")  # so that sets differ
        for number in range(count):
            rng = np.random.default_rng([rule.seed, of_set, number])
            cameras.append(sampler.draw(rng))
            sets.append(name)
    focal = float(np.median([camera.focal for camera in base]))
    return Viewpoints(rule, source, focal, tuple(cameras), tuple(sets), scene.offset)


def check_rule(rule: Rule) -> None:
    """RunError, naming the option, for a rule that cannot be followed."""
    check_limits(rule, "sample.")
    low, high = rule.screens
    if low > high:
        raise RunError(f"--sample.screens {low:g} {high:g}: from the smaller to the larger: {high:g} {low:g}")
    if not sum(rule.places):
        raise RunError("--sample.places 0 0 0: no viewpoints anywhere; choose shares such as 0.4 0.4 0.2")


def in_words(drawn: Viewpoints) -> str:
    """What screens, lenses and places viewpoints were drawn for."""
    low, high = drawn.rule.screens
    shares = np.array(drawn.rule.places) / sum(drawn.rule.places)
    places = ("on the capture's path", "walking among its cameras", "stepping back from them")
    where = [f"{share:.0%} {place}" for share, place in zip(shares, places, strict=True) if share > 0]
    screens = f"screens of {low:g} to {high:g} times the photos' focal length of {drawn.focal:.0f} pixels"
    lenses = f"lenses: the photos' and up to {drawn.rule.fov:g} degrees"
    return f"{screens}; {lenses}; viewpoints: {', '.join(where)}"


def capture_cameras(scene: Scene) -> list[Camera]:
    """The cameras of training and calibration photos: test photos stay out of everything."""
    return [scene.views[row].camera.neutral for row in (*scene.train_ids, *scene.calibration_ids)]


class _Sampler:
    """Draws one viewpoint after the other."""

    def __init__(self, scene: Scene, base: Sequence[Camera], rule: Rule):
        self.base, self.rule = base, rule
        self.position = np.stack([camera.position for camera in base]).astype(np.float64)
        self.rotation = np.stack([camera.w2c[:3, :3].T for camera in base]).astype(np.float64)
        self.points = scene.points.xyz.astype(np.float64)
        self.tree = KDTree(self.points) if len(self.points) else None
        self.free = self._free(self.position)
        self.extent = scene.scale
        apart = np.linalg.norm(self.position[:, None] - self.position, axis=2) / self.extent
        direction = self.rotation[:, :, 2]
        apart += np.linalg.norm(direction[:, None] - direction, axis=2)
        self.near = np.argsort(apart, axis=1, kind="stable")[:, 1 : rule.neighbours + 1]
        up = -self.rotation[:, :, 1].mean(0)
        self.up = up / max(np.linalg.norm(up), 1e-12)
        if len(self.points):
            away = np.linalg.norm(self.points - np.median(self.points, 0), axis=1)
            self.inner = self.points[away <= np.median(away)]

    def _free(self, positions: np.ndarray) -> np.ndarray:
        """Distance from positions to the closest point of the capture; inf without points."""
        if self.tree is None:
            return np.full(len(positions), np.inf)
        return np.asarray(self.tree.query(positions)[0])

    def draw(self, rng: np.random.Generator) -> Camera:
        place = PLACES[int(np.searchsorted(np.cumsum(self._shares()), rng.uniform(), "right"))]
        one = int(rng.integers(len(self.base)))
        for _ in range(_TRIES if place != "back" else 0):
            one = int(rng.integers(len(self.base)))
            rotation, position, clear = (self._on_path if place == "path" else self._walking)(one, rng)
            if not self._free(position[None])[0] < clear:
                break
        else:
            rotation, position = self.rotation[one], self.position[one]
        if place == "back":
            position = position - rng.uniform() * self._depth(one) * rotation[:, 2]
        w2c = np.eye(4)
        w2c[:3, :3] = rotation.T
        w2c[:3, 3] = -w2c[:3, :3] @ position
        return self._on_screen(replace(self.base[one], w2c=w2c.astype(np.float32)), rng)

    def _shares(self) -> np.ndarray:
        """Of PLACES; only the path where nothing is known to walk around or to step back from."""
        shares = np.array(self.rule.places if self.tree else (1.0, 0.0, 0.0))
        return shares / shares.sum()

    def _on_path(self, one: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
        """Camera to world, position, and how clear of the capture's points it has to be."""
        other = int(rng.choice(self.near[one])) if self.near.shape[1] else one
        share = rng.uniform()
        position = (1 - share) * self.position[one] + share * self.position[other]
        position += self.extent * rng.uniform(-self.rule.shift, self.rule.shift, 3)
        turned = Slerp([0, 1], Rotation.from_matrix(self.rotation[[one, other]]))(share)
        turned *= Rotation.from_rotvec(rng.uniform(-self.rule.turn, self.rule.turn, 3))
        return turned.as_matrix(), position, _CLEAR * min(self.free[one], self.free[other])

    def _walking(self, one: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
        low, high = self.position.min(0), self.position.max(0)
        grown = _GROWN * (high - low)
        position = rng.uniform(low - grown, high + grown)
        height = self.position[one] @ self.up + self.extent * rng.uniform(-_RISE, _RISE)
        position += self.up * (height - position @ self.up)
        ahead = self.inner[int(rng.integers(len(self.inner)))] - position
        rotation = looking(position, ahead, self.up)[:3, :3].T
        return rotation, position, _CLEAR * float(np.quantile(self.free, _CROWDED))

    def _depth(self, one: int) -> float:
        """Median depth of the points before a camera; the extent where there are none."""
        depth = (self.points - self.position[one]) @ self.rotation[one][:, 2]
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else self.extent

    def _on_screen(self, camera: Camera, rng: np.random.Generator) -> Camera:
        """The camera on a screen of the rule."""
        s = float(np.exp(rng.uniform(*np.log(self.rule.screens))))
        shaped, ratio = rng.uniform() < _SHAPED, float(np.exp(rng.uniform(*_RATIOS)))
        size = np.array([camera.width, camera.height], np.float64)
        if shaped:
            same = math.sqrt(size.prod()) * np.array([ratio**0.5, ratio**-0.5])
            widest = 2 * math.tan(math.radians(self.rule.fov) / 2) * camera.focal / same.min()
            new = same * max(widest, 1) ** rng.uniform()
            most = min(_MORE_PIXELS * self.rule.screens[1] ** 2 * size.prod(), MOST_PIXELS)
            size, s = new, min(s, math.sqrt(most / new.prod()))
        new = np.maximum(np.round(s * size), 1).astype(int)
        K = camera.K.astype(np.float64)
        K[:2] *= s
        if shaped:
            K[:2, 2] = new / 2
        return replace(camera, K=K.astype(np.float32), width=int(new[0]), height=int(new[1]))


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
    head |= {"offset": drawn.offset} if any(drawn.offset) else {}
    write_json(path, {**head, "focal": drawn.focal, "viewpoints": entries})


@dataclass(frozen=True, kw_only=True)
class _Drawn(ViewpointsFile):
    rule: Rule
    cameras: str
    focal: Positive


def read_viewpoints(path: Path) -> Viewpoints:
    """What `write_viewpoints` wrote; DataError where the content cannot be used."""
    what, cure = "a file of viewpoints", "delete it and run `sagesplat sample` again"
    made = read_json_as(path, _Drawn, what, cure)
    with refused(path, what, cure):
        cameras = tuple(entry.camera() for entry in made.viewpoints)
        sets = tuple(entry.set for entry in made.viewpoints)
        if unknown := set(sets) - set(SETS):
            raise ValueError(f"unknown set {unknown.pop()!r}")
    return Viewpoints(made.rule, made.cameras, made.focal, cameras, sets, made.offset)


def read_cameras(path: Path, like: Camera, offset: Position = NO_OFFSET) -> list[Camera]:
    """Base cameras from a file: a viewpoints.json, or the frames of a transforms.json (poses only).

    Args:
        path: The file. Frames need a `transform_matrix` (camera to world, OpenGL axes, the capture's world).
        like: Its intrinsics and image size are those of all frames.
        offset: That was subtracted from all positions of the capture (`Scene.offset`).

    Returns:
        At least one camera.

    Raises:
        DataError: Where the file cannot be used.
    """
    cure = "give a viewpoints.json, or a transforms.json whose frames have a transform_matrix"
    document = read_json(path, cure)
    with refused(path, "a list of viewpoints", cure):
        if isinstance(document, dict) and document.get("format") == VIEWPOINTS:
            made = convert_as(document, ViewpointsFile)
            x, y, z = np.subtract(offset, made.offset).tolist()
            entries = [replace(entry, w2c=less_offset(entry.w2c, (x, y, z))) for entry in made.viewpoints]
            cameras = [entry.camera() for entry in entries]
        else:
            frames = convert_as(document, Poses).frames
            poses = [less_offset(frame.world_to_camera(), offset) for frame in frames]
            cameras = [replace(like.neutral, w2c=w2c.astype(np.float32)) for w2c in poses]
        if not cameras:
            raise ValueError("no viewpoints")
    return cameras
