"""Pose refinement: small motions of the cameras, learned with the Gaussians or fitted to one photo.

A motion is a rotation vector (rad) and a translation (world units) in the frame of the camera: R x + t for x
in camera coordinates. Gradients come from `rasterize(pose=)`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from scipy.linalg import orth
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import project, to_camera
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Backend, Workspace, rasterize
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.lr_schedule import smaller, smaller_valid
from sagesplat.train.view_parameters import ViewParameters

_REACH = 0.03  # rad in the image: how far all steps of one view lead in one direction
_FASTEST, _PER_VISIT = 0.004, 2.5e-4  # rad in the image: largest learning rate, and for each visit of a view
_SHRINK_TO = 0.01  # the learning rate at the end, as a share of that at the start
_FROM, _ROUNDS, _LATEST = 0.03, 2, 0.2  # first step: share of the run, rounds of views; at most
_WARM_UP = 5  # updates of a view in which its learning rate grows
_PRIOR = 3.0  # rad, and extents: a step of 1 rad in the image moves no camera farther than this
_NEAREST = 0.01  # extents: points that are nearer to a camera say nothing about its motions
_ENOUGH = 10_000  # points, of a view without tracks
_FARTHEST = 0.1  # rad, and extents: a pose that moves farther than this diverges
_HELD = 1e30  # second moment of parameters that Adam no longer moves
_SMALLEST = 40  # pixels of the shorter side of a smaller photo
_SETTLED = 1e-5  # relative change of the loss at which a fit ends
_FIT = ((4, 12), (2, 8), (1, 6))  # how many times smaller a photo is that a pose is fitted to, and iterations


def moved(w2c: Float32[np.ndarray, "4 4"], motion: Float[np.ndarray, "6"]) -> Float32[np.ndarray, "4 4"]:
    """A camera after a motion, computed in float64."""
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:]
    return (step @ w2c).astype(np.float32)


def moved_camera(camera: Camera, motion: Float32[Tensor, "6"]) -> Camera:
    """A camera after a motion that is a tensor on any device."""
    return replace(camera, w2c=moved(camera.w2c, motion.detach().cpu().double().numpy()))


@dataclass(frozen=True, eq=False)
class PoseUpdate:
    """A `ViewUpdate`: Adam on the motions of the training cameras.

    A motion is `axes[view]` times the view's parameters. Steps of the same length in any direction move the
    image about equally far: a turn and a shift that nearly undo each other are found as easily as either.

    A rotation, translation or scaling of all training cameras together changes no photo once the Gaussians
    follow it, so it is projected out: refined poses stay in the frame of the given ones. A pose that diverges
    goes back to the given one and stays there; if most do, all do.
    """

    axes: Float32[Tensor, "V 6 6"]
    gauge: Float32[Tensor, "R K"]  # orthonormal columns: parameters of the T training cameras, R = 6 T
    train_ids: Int64[Tensor, " T"]
    scale: float  # the scene's, world units
    first_step: int
    last_step: int
    visits: float  # updates of each view
    size: ClassVar[int] = 6

    def __call__(
        self, parameters: ViewParameters, views: Sequence[int], grad: Float32[Tensor, "R D"], step: int
    ) -> None:
        """See `ViewUpdate`."""
        gauge, rows = self.gauge.to(grad.device), self.train_ids.to(grad.device)
        warm = (parameters.counts[list(views)][:, None] + 1) / _WARM_UP
        parameters.adam_step(views, grad, self.rate(step) * warm.clamp_max(1.0), joint=True)
        self._hold(parameters, rows)
        values = parameters.values[rows].reshape(-1)
        parameters.values[rows] = (values - gauge @ (gauge.T @ values)).view(-1, 6)
        parameters.values[diverged(parameters)] = 0.0

    def _hold(self, parameters: ViewParameters, rows: Int64[Tensor, " T"]) -> None:
        """Hold poses that diverged where they were given."""
        far = self.motions(parameters.values[rows], rows).view(-1, 2, 3).norm(dim=-1)
        far = (far > far.new_tensor([_FARTHEST, _FARTHEST * self.scale])).any(1) | diverged(parameters)[rows]
        held = rows if 2 * far.sum() > len(rows) else rows[far]
        parameters.values[held], parameters.exp_avg[held], parameters.exp_avg_sq[held] = 0.0, 0.0, _HELD

    def motions(self, values: Float32[Tensor, "R 6"], views: Int64[Tensor, " R"]) -> Float32[Tensor, "R 6"]:
        """The motions of views: rotation vectors (rad) and translations (world units)."""
        return torch.einsum("vij,vj->vi", self.axes.to(values.device)[views], values)

    def motion(self, view: int, values: Float32[Tensor, "6"]) -> Float32[Tensor, "6"]:
        """The motion of one view."""
        return self.axes[view].to(values.device) @ values

    def rate(self, step: int) -> float:
        """Learning rate in rad of the image: it decays exponentially."""
        share = (step - self.first_step) / max(1, self.last_step - self.first_step)
        mean = (1 - _SHRINK_TO) / -np.log(_SHRINK_TO)
        rate = min(_FASTEST, _PER_VISIT * self.visits, _REACH / (mean * max(1.0, self.visits)))
        return float(rate * _SHRINK_TO**share)


def pose_update(scene: Scene, max_steps: int, batch: int) -> PoseUpdate:
    """The pose refinement of a training of `max_steps` steps of `batch` photos."""
    rows = scene.train_ids
    first = 1 + round(min(_LATEST * max_steps, max(_FROM * max_steps, _ROUNDS * len(rows) / batch)))
    axes = np.stack([motion_axes(scene, view) for view in range(len(scene.views))])
    cameras = np.stack([scene.views[row].camera.w2c for row in rows]).astype(np.float64)
    gauge = np.linalg.solve(axes[rows], gauge_motions(cameras, scene.scale)).reshape(-1, 7)
    return PoseUpdate(
        axes=torch.from_numpy(axes.astype(np.float32)),
        gauge=torch.from_numpy(orth(gauge, rcond=1e-6).astype(np.float32)),
        train_ids=torch.from_numpy(rows),
        scale=scene.scale,
        first_step=first,
        last_step=max_steps,
        visits=(max_steps - first) * batch / len(rows),
    )


def diverged(parameters: ViewParameters) -> Bool[Tensor, " V"]:
    """Views whose pose diverged and was put back."""
    return parameters.exp_avg_sq[:, 0] > _HELD / 1e10


def refined_cameras(scene: Scene, update: PoseUpdate, parameters: ViewParameters) -> list[Camera]:
    """The cameras of all views after training; those of held-out views are as they were given."""
    return [
        moved_camera(view.camera, update.motion(row, values)) if values.any() else view.camera
        for row, (view, values) in enumerate(zip(scene.views, parameters.values, strict=True))
    ]


def motion_axes(scene: Scene, view: int) -> Float[np.ndarray, "6 6"]:
    """Columns: motions of a view's camera that each move its image by about 1 rad, without common effects.

    The inverse root of J^T J, with J the derivative of the view's SfM points in the image (focal length 1).
    A prior keeps motions small that hardly show.
    """
    points, camera = scene.points, scene.views[view].camera
    seen = np.unique(points.track_points[points.track_views == view])
    xyz = points.xyz[seen] if len(seen) else points.xyz[:: 1 + len(points.xyz) // _ENOUGH]
    xyz, w2c = xyz.astype(np.float64), camera.w2c.astype(np.float64)
    pixels, depths = project(xyz, w2c, camera.K.astype(np.float64))
    inside = ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(1)
    local = to_camera(xyz[inside & (depths > _NEAREST * scene.scale)], w2c)
    x, y, z = local.T
    zero, one = np.zeros_like(z), np.ones_like(z)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).reshape(-1, 3, 3)
    slopes = np.stack([one, zero, -x / z, zero, one, -y / z], -1).reshape(-1, 2, 3) / z[:, None, None]
    jacobian = np.concatenate([slopes @ turned, slopes], -1)
    prior = np.diag([1 / _PRIOR**2] * 3 + [1 / (_PRIOR * scene.scale) ** 2] * 3)
    information = np.einsum("pij,pik->jk", jacobian, jacobian) / max(1, len(local)) + prior
    values, vectors = np.linalg.eigh(information)
    return vectors / np.sqrt(values) @ vectors.T  # symmetric: the signs of eigenvectors are arbitrary


def gauge_motions(w2c: Float[np.ndarray, "T 4 4"], scale: float) -> Float[np.ndarray, "T 6 7"]:
    """Motions of T cameras that a rotation, a translation and a scaling of the world amount to.

    Of 1 rad about the mean of the camera centres, of `scale`, and by a factor of e, to first order.
    """
    rotations = w2c[:, :3, :3]
    centres = -np.einsum("vji,vj->vi", rotations, w2c[:, :3, 3])
    centres = centres - centres.mean(0)
    motions = np.zeros((len(w2c), 6, 7))
    motions[:, :3, :3], motions[:, 3:, 3:6] = -rotations, -scale * rotations
    motions[:, 3:, 6] = -np.einsum("vij,vj->vi", rotations, centres)
    for k, axis in enumerate(np.eye(3)):
        motions[:, 3:, k] = -np.einsum("vij,vj->vi", rotations, np.cross(axis, centres))
    return motions


def fit_pose(
    gaussians: Gaussians,
    camera: Camera,
    photo: UInt8[np.ndarray, "H W 3"],
    axes: Float[np.ndarray, "6 6"],
    scale: float,
    config: TrainConfig,
    *,
    valid: Bool[np.ndarray, "H W"] | None = None,
    backend: Backend = "auto",
    workspace: Workspace | None = None,
) -> Camera:
    """The camera near a given one whose render of fixed Gaussians is most like a photo.

    L-BFGS on the training loss, on smaller photos at first. The given camera is returned where the search
    diverges.

    Args:
        gaussians: They stay as they are.
        camera: Where the search begins.
        photo: Of the camera's size.
        axes: Of `motion_axes`.
        scale: The scene's, world units.
        config: Of the training: antialiasing and the loss.
        valid: The pixels of the photo that count; None: all.
        backend: Rasteriser.
        workspace: Memory to use again.
    """
    device, found = gaussians.means.device, camera
    shortest = min(camera.width, camera.height)
    for factor, iterations in (f for f in _FIT if f[0] == 1 or shortest >= f[0] * _SMALLEST):
        pixels, small = smaller(photo, found, factor)
        target = torch.from_numpy(pixels).to(device)
        target = target.float() / 255 if device.type == "cpu" else target
        counts = None if valid is None else torch.from_numpy(smaller_valid(valid, factor)).to(device)

        def loss(
            at: np.ndarray, small: Camera = small, target: Tensor = target, counts: Tensor | None = counts
        ) -> tuple[float, np.ndarray]:
            pose = torch.zeros(6, device=device, requires_grad=True)
            render = rasterize(
                gaussians, replace(small, w2c=moved(small.w2c, axes @ at)),
                antialiased=config.antialiased, pose=pose, workspace=workspace, backend=backend,
            )  # fmt: skip
            value = photometric_loss(render.rgb, target, workspace=workspace, valid=counts)
            value.backward()
            assert pose.grad is not None
            return float(value.detach()), axes.T @ pose.grad.cpu().numpy().astype(np.float64)

        best = minimize(
            loss, np.zeros(6), jac=True, method="L-BFGS-B", options={"maxiter": iterations, "ftol": _SETTLED}
        )
        found = replace(found, w2c=moved(found.w2c, axes @ best.x))
    return found if _near(camera, found, scale) else camera


def _near(a: Camera, b: Camera, scale: float) -> bool:
    """Whether two cameras are no farther apart than a refined pose may be from the given one."""
    turn = Rotation.from_matrix(a.w2c[:3, :3] @ b.w2c[:3, :3].T).magnitude()
    return bool(turn <= _FARTHEST and np.linalg.norm(a.position - b.position) <= _FARTHEST * scale)
