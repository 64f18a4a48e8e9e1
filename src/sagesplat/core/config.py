"""Settings of every stage. Standard library only, so that the command line answers at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class SceneConfig:
    """How a capture is read."""

    downscale: int = 1
    """Train on photos made this many times smaller (images_N is used where it is shipped)."""
    test_every: int = 8
    """Every n-th view by name is a test view, seen by nothing but the evaluation; 0 = none."""
    calibrate_every: int = 8
    """Every n-th of the others is kept from training too, to calibrate the promises on; 0 = none."""


@dataclass(frozen=True)
class PosesConfig:
    """How camera poses are found for photos that come without."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which photos are compared: all pairs, or neighbours by name; auto: neighbours for videos and many."""
    camera: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Which photos share intrinsics; auto: those of one size, camera and zoom."""
    model: str = "OPENCV"
    """COLMAP's camera model."""
    refine_principal_point: bool = False
    """For photos that were cropped, each in its own way."""
    max_size: int = 3200
    """Larger side in pixels: of photos for features, and of the undistorted photos."""
    max_frames: int = 300
    """Frames taken of a video."""
    min_registered: float = 0.5
    """Share of the photos whose pose must be found."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Of features and matching."""
    threads: int = -1
    """-1: all cores."""
    seed: int = 0


@dataclass(frozen=True)
class MasksConfig:
    """Where label images come from."""

    segmenter: Literal["auto", "masks", "hf", "onnx", "deeplabv2"] = "auto"
    """masks: ready label images; hf: a network of Hugging Face; onnx: one in ONNX format; deeplabv2: the
    paper's. auto: masks where there are some, else by --model."""
    masks: Path | None = None
    """Folder of label images (default: SCENE/masks)."""
    model: str | None = None
    """The network: a name on huggingface.co or a folder (hf; default: EoMT small), a .onnx file or a
    checkpoint."""
    classes: Path | None = None
    """JSON with the class names of an ONNX network and their category ids."""
    head: Literal["coco-stuff", "voc"] = "coco-stuff"
    """What the checkpoint of deeplabv2 was trained on."""
    crf: bool = False
    """Let borders follow the edges of the photo (deeplabv2)."""
    batch: int = 1
    """Photos that a network looks at together."""
    soft: bool = False
    """Keep the network's probabilities too, for `fuse`."""


@dataclass(frozen=True)
class LabelsConfig:
    """What becomes of the categories: first merge, then keep, then min-share."""

    keep: str = ""
    """Only these, such as "grass-merged,tree-merged"; the others become unlabelled."""
    merge: str = ""
    """Put together, such as "vase=potted plant,potted plant=tree-merged"."""
    min_share: float = 0.0
    """Categories with a smaller share of all pixels become unlabelled."""


@dataclass(frozen=True)
class LiftConfig:
    """How label images become labels of points."""

    votes: Literal["track", "projection"] = "track"
    """Which pixels vote on a point: those of its track, or all views it projects into."""


@dataclass(frozen=True)
class TrainConfig:
    """3D Gaussian splatting as published. Step numbers are for a 30 000-step run and scale with max_steps."""

    max_steps: int = 7000
    lr_schedule: Literal["fast", "published"] = "fast"
    """fast: larger steps at first, and smaller photos where they tell as much; published: 3DGS's rates."""
    level_every: int = 0
    """Record a level every so many steps (0: a thirtieth of max_steps)."""
    sh_degree: int = 3
    ssim_weight: float = 0.2
    antialiased: bool = False
    """Scale opacities by the area that the screen-space low-pass adds."""
    batch: int = 1
    """Photos a step looks at (at least one per process); rates grow by its square root, max_steps does not
    shrink."""
    means_lr: float = 1.6e-4
    """Times the scene's extent; falls exponentially to a hundredth."""
    quats_lr: float = 1e-3
    log_scales_lr: float = 5e-3
    logit_opacities_lr: float = 5e-2
    sh0_lr: float = 2.5e-3
    shN_lr: float = 1.25e-4
    strategy: Literal["default", "mcmc"] = "default"
    """How Gaussians come and go: clone, split, prune, reset as 3DGS, or relocation and noise as 3DGS-MCMC."""
    refine_every: int = 100
    """Densify every so many steps (not scaled: its statistics need the views)."""
    refine_start: int = 500
    """Not scaled either (at most a fifth of the run): before, gradients say little."""
    refine_stop: int = 15_000
    reset_every: int = 3000
    """Opacities are reset every so many steps while densification runs."""
    raise_sh_every: int = 1000
    grow_grad: float = 2e-4
    """Mean screen-space gradient (half images) above which a Gaussian is cloned or split."""
    absgrad: bool = False
    """Densify by sums of absolute gradients over pixels (AbsGS), above grow_absgrad."""
    grow_absgrad: float = 8e-4
    grow_scale: float = 0.01
    """Split rather than clone above this share of the extent."""
    prune_opacity: float = 5e-3
    prune_scale: float = 0.1
    """After the first reset, Gaussians larger than this share of the extent go."""
    max_gaussians: int = 0
    """Cap of densification, reached in a straight line (0: by the size of the photos)."""
    mcmc_noise: float = 5e5
    """Times the rate of the means: how far MCMC's Gaussians wander."""
    mcmc_opacity: float = 0.01
    """Weight of the mean opacity in MCMC's loss."""
    mcmc_scale: float = 0.01
    """Weight of the mean scale in MCMC's loss."""
    levels_after_reset: bool = False
    """Record a level that falls on an opacity reset right after it (as the paper may have), not before."""
    freeze_at: float | None = None
    """Stop each category when its mean SSIM on the training views reaches this (Fig. 1 of the paper)."""
    gradient_freeze_share: float = 0.0
    """To compare with: after densification, the Gaussians whose gradients are within this smallest share rest
    every other hundred steps (GSta). A run that is interrupted then goes on a little differently."""


@dataclass(frozen=True)
class BlocksConfig:
    """How a large scene is divided."""

    count: int = 1
    """Blocks of the ground plane, each trained like a scene of its own (--train holds for each); 1: the
    scene as one."""
    margin: float = 0.2
    """How far training reaches beyond a block, as a share of its width."""
    min_share: float = 0.25
    """A photo is for a block if at least this share of the points that it sees are the block's."""
    far_share: float = 0.5
    """Points beyond the margin that a block begins with too, at most, as a share of its own: the background
    of its photos."""
    boundary_steps: int = 300
    """Training steps along the borders of each block, when the blocks are put together."""


@dataclass(frozen=True)
class NestConfig:
    """How a trained model becomes a ladder whose levels contain each other."""

    steps: int = 3000
    """Training steps on random compositions."""
    levels: int = 16
    """Prefixes that are measured and planned with, in geometric steps of their size."""
    smallest: float = 0.01
    """Share of a category's Gaussians in its lowest level."""
    drawn_from: float = 0.05
    """Share of a category in the smallest prefix that training looks at: fewer serve easy categories only."""
    base_share: float = 0.2
    """Share of the Gaussians, the first of all, that a small 3DGS-MCMC training makes; 0: none."""
    base_steps: int = 3000
    """Steps of that training."""
    full_share: float = 0.1
    """Share of the steps that look at everything, to begin with."""
    full_share_end: float = 0.9
    """The same at the end: the whole model needs the last word."""
    sh_bits: tuple[int, int] = (5, 4)
    """Bits of harmonics in the chunks, of degree 1 and of those above; training gets used to them."""
    criterion: Literal["weight", "weight-volume", "peak", "sensitivity", "opacity"] = "sensitivity"
    """What orders the Gaussians of a category; docs/nested.md compares them."""
    lr_multiplier: float = 4.0
    """Rates to begin with, times those of a published run's last third; they fall to a twentieth."""


@dataclass(frozen=True)
class FitConfig:
    """How the quality models are fitted."""

    distance: Literal["percentile", "minimum"] = "percentile"
    """d_min of a category in a view: 5th percentile over its points in sight, or the paper's minimum."""
    masks: Literal["given", "rendered"] = "given"
    """Pixels of a category: those of the label image, or those that its Gaussians paint most of."""
    region: Literal["mask", "eroded"] = "mask"
    """Where a category is measured: all its pixels, or those at least 5 px from another category."""
    min_share: float = 5e-4
    """A view counts for a category if this share of its pixels, at least, is of the category."""
    confidence: float = 0.95
    """Share of the promises that are to be kept on views that nobody took a photo from."""


@dataclass(frozen=True)
class PlanConfig:
    """What is promised."""

    target_ssim: float = 0.8
    share: float = 0.95
    """Share of the training views in which a category's level must reach the target."""
    tune_steps: int = 0
    """Train a composition as a whole for so many steps, so that its categories fit each other."""
    other_targets: tuple[float, ...] | None = None
    """Targets planned and measured beside the main one (default: 0.1 below and above)."""
    budget: float = 0.0
    """Compose for a budget instead of the main target; 0: no budget."""
    budget_unit: Literal["bytes", "gpu-bytes", "count"] = "bytes"
    """Bytes to send, bytes on the viewer's GPU, or Gaussians."""
    weights: dict[str, float] = field(default_factory=dict)
    """How much a category counts within the budget, by name (1 unless named)."""

    @property
    def targets(self) -> list[float]:
        """All targets, ascending."""
        near = (self.target_ssim - 0.1, self.target_ssim + 0.1)
        others = [t for t in near if 0 < t < 1] if self.other_targets is None else self.other_targets
        return sorted({round(t, 6) for t in (self.target_ssim, *others)})


@dataclass(frozen=True)
class PaperConfig:
    """What the paper's tables and figures look at."""

    view: str | None = None
    """Photo of Tables III and IV and of Fig. 4 (default: the middle one of the test views)."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS (default: where `sagesplat download lpips` puts them)."""
    tune_steps: int = 500
    """Training steps of pruned 3DGS, and of tuned compositions, in Table IV."""


@dataclass(frozen=True)
class CompareConfig:
    """Which baselines stand beside the nested ladder."""

    targets: tuple[float, ...] = ()
    """SSIM that SAGE composes for (default: 0.6 0.7 0.8, and what the run was planned for)."""
    snapshots: int = 10
    """At most so many of the training's snapshots, spread in size."""
    shares: tuple[float, ...] = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
    """Shares of its Gaussians that the last snapshot is pruned to."""
    tune_steps: int = 500
    """Training steps of a pruned one; -1: as many as the nested ladder was trained on compositions."""
    caps: tuple[float, ...] = (0.1, 0.2, 0.35, 0.5, 1.0)
    """Caps of 3DGS-MCMC, each trained from the start, as shares of the last snapshot's Gaussians."""
    budgets: int = 12
    """Budgets of bytes that the nested ladder is planned for, in geometric steps."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS (default: where `sagesplat download lpips` puts them)."""


@dataclass(frozen=True)
class BundleConfig:
    """What a bundle says of its scene."""

    meters_per_unit: float | None = None
    """Scale of the scene, for headsets (default: guessed from the cameras' height)."""
    always: tuple[str, ...] = ()
    """Categories shipped in full whatever the plan says."""
    weights: dict[str, float] = field(default_factory=dict)
    """How much categories count in the viewer's plans, as NAME VALUE ... (default: 1 each)."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run needs to be done again."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    masks: MasksConfig = field(default_factory=MasksConfig)
    labels: LabelsConfig = field(default_factory=LabelsConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    blocks: BlocksConfig = field(default_factory=BlocksConfig)
    nest: NestConfig = field(default_factory=NestConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    fuse: bool = False
    """Let all views vote on the label images, once the scene is trained."""
    ladder: Literal["nested", "snapshots"] = "nested"
    """Levels that contain each other, or the paper's: what training recorded on its way."""
    seed: int = 0
