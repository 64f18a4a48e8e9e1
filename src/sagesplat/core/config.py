"""Settings of every stage, with their limits. They import little: the command line answers at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from sagesplat.core.limits import Fov, NotNegative, Screen, Seed, Share, SomeShare

_MOST = 2**31 - 1
Int31 = Annotated[int, Meta(ge=0, le=_MOST)]  # steps, views, pixels
PositiveInt31 = Annotated[int, Meta(ge=1, le=_MOST)]
Downscale = Annotated[int, Meta(ge=0, le=1024)]
BelowOne = Annotated[float, Meta(ge=0, lt=1)]
Side = Annotated[int, Meta(ge=1, le=4096)]  # pixels
NumCells = Annotated[int, Meta(ge=0, le=4096)] | Literal["auto"]
Viewpoints = Annotated[int, Meta(ge=0, le=10_000)]
Weight = Annotated[float, Meta(ge=0, le=1e6)]
SomeViewpoints = Annotated[int, Meta(ge=1, le=10_000)]
LevelShares = Annotated[tuple[SomeShare, ...], Meta(min_length=1)]

LadderKind = Literal["nested", "snapshots"]  # prefixes of one model, or the levels that training recorded


@dataclass(frozen=True)
class SceneConfig:
    """How the capture is read."""

    downscale: Downscale = 0
    """Downscaling factor of the photos that are trained on; 0: 1, but on a CPU 2, 4 or 8 where photos have
    more than 1.25 megapixels. images_N is read where the capture has it."""
    test_every: Int31 = 8
    """Every n-th view by name is a test view, used for evaluation only; 0: none."""
    calibrate_every: Int31 = 8
    """Every n-th of the other views is held out of training, to calibrate the quality models; 0: none."""
    alpha: Literal["auto", "background", "ignore"] = "auto"
    """Transparent pixels of photos. background: an object that was cut out, composited over the background;
    ignore: pixels that do not count; auto: background if most of the photos' border is transparent."""
    vignetting: bool = False
    """Undo the vignetting of the photos: the light that the lens loses towards the corners, estimated from
    points that photos show at different places. Quality is then measured against the corrected photos."""
    images: Path | None = None
    """Folder of the photos that poses are for (default: found beside the poses)."""
    fisheye: Literal["crop", "faces"] = "crop"
    """Photos of fisheye lenses. crop: what one straight view shows of them; faces: all of them, as the faces
    of a cube. Photos of 360 degrees always become faces."""


@dataclass(frozen=True)
class PosesConfig:
    """Camera poses, estimated by COLMAP for photos that have none."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Photo pairs that are matched. exhaustive: all; sequential: neighbours by name; auto: sequential for
    videos and for large sets."""
    camera: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Photos that share intrinsics. auto: those of the same size, camera and focal length."""
    model: str = "OPENCV"
    """Camera model of COLMAP."""
    refine_principal_point: bool = False
    """Estimate the principal point too, for photos that were cropped one by one."""
    max_size: Annotated[int, Meta(ge=64, le=_MOST)] = 3200
    """Longer side of the photos for feature extraction, and of the undistorted photos, pixels."""
    max_frames: PositiveInt31 = 300
    """Frames that are taken from a video."""
    min_registered: Share = 0.5
    """Fraction of the photos that must get a pose."""


@dataclass(frozen=True)
class MasksConfig:
    """Where label images come from."""

    segmenter: Literal["auto", "masks", "hf", "onnx", "deeplabv2", "text"] = "auto"
    """Source of the label images. masks: image files; hf: a network of Hugging Face; onnx: a network in ONNX
    format; deeplabv2: the network of the paper; text: networks that find --prompts; auto: masks if the
    capture has them, else text with --prompts, else by the suffix of --model."""
    prompts: str = ""
    """Categories in your own words, e.g. "stone fountain; ivy; wooden bench". With --segmenter hf, onnx,
    deeplabv2 or masks they are painted over the categories of that network or of the label images."""
    masks: Path | None = None
    """Folder of label images (default: SCENE/masks)."""
    model: str | None = None
    """Network: a name on huggingface.co or a folder (hf; default: EoMT small), a .onnx file, a checkpoint
    (deeplabv2), or the network for --prompts (text; default: Grounding DINO tiny)."""
    prompt_model: str | None = None
    """Network for --prompts where --model is that of another segmenter: Grounding DINO, OWLv2, CLIPSeg or
    SAM 3, a name on huggingface.co or a folder."""
    mask_model: str | None = None
    """Network that makes masks of the boxes of Grounding DINO and OWLv2: SAM 2 or SAM (default: SAM 2.1
    tiny)."""
    prompt_threshold: BelowOne = 0.0
    """Score from which on a prompt counts as found (0: 0.3 for Grounding DINO, 0.2 for OWLv2, 0.4 for
    CLIPSeg, 0.5 for SAM 3)."""
    classes: Path | None = None
    """JSON file with the class names of an ONNX network and their category ids."""
    crf: bool = False
    """Refine the label images with a dense CRF (deeplabv2)."""


@dataclass(frozen=True)
class LabelsConfig:
    """Changes to the categories: merge first, then ignore, then keep, then the minimum share."""

    keep: str = ""
    """Keep these categories, e.g. "grass-merged,tree-merged"; all others become unlabelled."""
    merge: str = ""
    """Merge categories, e.g. "vase=potted plant,potted plant=tree-merged"."""
    min_share: Share = 0.0
    """Categories that cover less than this fraction of all pixels become unlabelled."""
    ignore: str = ""
    """Categories that do not belong to the scene, e.g. "person,car": their pixels are not trained on, not
    measured and have no vote."""
    instances: str = ""
    """Tell instances of these categories apart, e.g. "chair,car" (things: of all that can be counted; *: of
    all). Each becomes a category of its own, "chair 1", "chair 2"; --labels.merge "chair 1=chair" folds one
    back."""


@dataclass(frozen=True)
class TrainConfig:
    """3DGS training (step numbers are for 30,000 steps and scale with --train.max-steps)."""

    max_steps: Annotated[int, Meta(ge=1, le=10**9)] = 7000
    """Training steps."""
    lr_schedule: Literal["fast", "published"] = "fast"
    """Learning rates. fast: larger at first, on downscaled photos where those have the same detail, and no
    opacity resets; published: as in 3DGS."""
    level_every: Annotated[int, Meta(ge=0, le=10**9)] = 0
    """Steps between two recorded levels, not scaled (0: a thirtieth of --train.max-steps)."""
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    """Degree of the spherical harmonics."""
    antialiased: bool = True
    """Compensate opacities for the screen-space low-pass filter (Mip-Splatting): Gaussians smaller than a
    pixel then look the same at lower resolutions and from far away."""
    batch: Annotated[int, Meta(ge=1, le=10**6)] = 1
    """Photos per step, at least one per process. Learning rates grow with its square root; the number of
    steps stays."""
    exposure: Literal["auto", "off", "affine"] = "auto"
    """Exposure and white balance of the photos. affine: learn a colour transform per photo; off: none; auto:
    affine where the photos differ."""
    sky: Literal["auto", "off"] = "auto"
    """Sky on a far sphere. auto: Gaussians begin there where photos show a category of that name, and stay on
    it; off: the sky is trained like everything else."""
    strategy: Literal["default", "mcmc"] = "default"
    """Densification. default: clone, split, prune and reset as 3DGS; mcmc: relocation and noise as
    3DGS-MCMC, from 15,000 steps on with its regularisation."""
    refine_every: PositiveInt31 = 100
    """Steps between two densifications, not scaled: the gradient statistics need the views."""
    refine_stop: Int31 = 15_000
    """Last step of densification."""
    grow_grad: NotNegative = 2e-4
    """Clone or split Gaussians whose mean screen-space gradient (in half image widths) is above this."""
    max_gaussians: Int31 = 0
    """Maximum number of Gaussians; the limit grows linearly during densification (0: choose from the image
    size)."""
    poses: bool = False
    """Refine the camera poses of the training views with the Gaussians. Those of held-out views are fitted to
    their photos afterwards."""
    outliers: bool = False
    """Leave out what single photos show and the model does not, such as people that no mask names: found by
    the residual, from 30 % of the steps on and after ten visits of each view (at the latest from 60 %)."""
    freeze_at: SomeShare | None = None
    """Stop each category when its mean SSIM in the training views reaches this (Fig. 1 of the paper)."""


@dataclass(frozen=True)
class CleanConfig:
    """Floaters: Gaussians in free space, removed after training."""

    floaters: Literal["remove", "keep"] = "remove"
    """remove: floaters are removed before the levels are made; keep: nothing is removed."""
    max_loss: Annotated[float, Meta(ge=0, le=100)] = 0.02
    """Largest loss of PSNR on the training and on the calibration views, dB. Where it would be more, fewer
    are removed."""


@dataclass(frozen=True)
class BlocksConfig:
    """Blocks of a large scene."""

    count: Annotated[int, Meta(ge=1, le=4096)] = 1
    """Ground-plane blocks that are trained independently and merged; 1: no blocks. The --train options hold
    for each block."""


@dataclass(frozen=True)
class NestConfig:
    """Nested levels: prefixes of one ordered model."""

    steps: Int31 = 2400
    """Training steps on random compositions of levels; in blocks an eighth more of them, near each border."""
    levels: Annotated[int, Meta(ge=1, le=64)] = 16
    """Levels per category; their sizes grow geometrically."""
    smallest: SomeShare = 0.01
    """Size of the lowest level, as a fraction of the category's Gaussians."""
    base_share: BelowOne = 0.2
    """Size of the base model, as a fraction of all Gaussians; it is a small 3DGS-MCMC model that forms the
    lowest levels; 0: none."""
    base_steps: PositiveInt31 = 1600
    """Training steps of the base model, which begins with the trained model, merged to that size."""
    cells: NumCells = "auto"
    """Parts of categories by place, in all, that have levels of their own, at least one in each block;
    0: each category is one (auto: by the number of Gaussians, at most 64)."""
    rate_weight: NotNegative = 6e-4
    """Loss per bit that the SH coefficients of a Gaussian take in a coded stream, on average; 0: only how it
    looks counts."""


@dataclass(frozen=True)
class AdoptConfig:
    """How a splat that somebody else trained is looked at, and how its levels are made."""

    fit: Literal["renders", "none"] = "renders"
    """Lower levels. renders: merged Gaussians, trained on the splat's own renders; none: merged Gaussians,
    fitted to some renders in a few passes."""
    steps: Int31 = 3000
    """Training steps on compositions of the lower levels."""
    shares: LevelShares = (0.004, 0.008, 0.016, 0.031, 0.0625, 0.125, 0.25, 0.5, 0.7, 1.0)
    """Sizes of the levels, as fractions of all Gaussians; categories that lose less keep fewer. Levels of
    fewer than 50 Gaussians are left out."""
    cells: NumCells = "auto"
    """Parts of categories by place, in all, that have levels of their own; 0: each category is one (auto: by
    the number of Gaussians, at most 64)."""
    lossless: bool = False
    """Send the highest levels as PLY, not rounded: the last one is then identical to the file."""
    cameras: Path | None = None
    """Where to look from: a capture with or without photos, a cameras.json of 3DGS, a transforms.json or a
    viewpoints.json (default: viewpoints drawn from the splat itself)."""
    views: Annotated[int, Meta(ge=1, le=10_000)] = 96
    """Viewpoints to draw."""
    kind: Literal["auto", "object", "place"] = "auto"
    """How viewpoints are drawn. object: on orbits around it; place: where one can stand in it."""
    up: str = "auto"
    """Up direction of the viewpoints: x, -x, y, -y, z or -z (auto: from the geometry)."""
    fov: Fov = 60.0
    """Field of view of the longer side of drawn viewpoints, degrees."""
    size: tuple[Side, Side] = (512, 384)
    """Width and height of drawn viewpoints, pixels."""
    lod: Annotated[int, Meta(ge=0, le=100)] = 0
    """Level of a streamed SOG to take as the reference; 0: the finest."""
    spz_axes: Literal["rub", "rdf"] = "rub"
    """Axes of an SPZ file that does not say them. rub: right, up, back, as the format has it; rdf: those of
    PLY, as PlayCanvas's tools write it."""
    seed: Seed = 0
    """Seed of the viewpoints and of the training."""


@dataclass(frozen=True)
class SampleConfig:
    """Viewpoints at which the levels are measured against the full model."""

    views: Viewpoints = 0
    """Viewpoints that the fidelity models are fitted to; 0: until their error stops shrinking, 200 at most,
    fewer after a short training."""
    calibration_views: Viewpoints = 0
    """Viewpoints that calibrate the bounds; 0: 170, fewer after a short training and up to 300 after a long
    one."""
    viewpoints: Path | None = None
    """File with the cameras to draw from: a viewpoints.json, or a transforms.json (default: the cameras of
    the training and calibration photos)."""
    shift: Share = 0.03
    """Largest random shift from the capture's path along each axis, as a fraction of the scene extent."""
    screens: tuple[Screen, Screen] = (0.5, 2.0)
    """Screens that promises are for, from and to: the viewer's focal length in pixels over the photos'."""
    places: tuple[Share, Share, Share] = (0.4, 0.4, 0.2)
    """Shares of the viewpoints: on the capture's path, walking among its cameras, stepping back from them."""
    fov: Fov = 100.0
    """Widest lens that promises are for: field of view of the picture's shorter side, degrees. The default is
    that of a headset's eye; half of the viewpoints have lenses between the photos' and this."""


@dataclass(frozen=True)
class FitConfig:
    """Quality models and what they are measured on."""

    distance: Literal["percentile", "minimum"] = "percentile"
    """Distance of a category in a view. percentile: 5th percentile over its visible points; minimum: as in
    the paper."""
    confidence: Annotated[float, Meta(gt=0, lt=1)] = 0.95
    """Target coverage of the lower confidence bounds, for views without a photo."""


@dataclass(frozen=True)
class PlanConfig:
    """Target quality or budget."""

    target_fidelity: SomeShare | None = None
    """Fidelity that the planned scene must reach: SSIM against the full model rendered from the same
    viewpoint (default: 0.95, where --target-ssim is not given; 1: the full model)."""
    target_ssim: SomeShare | None = None
    """SSIM against photos that the planned scene must reach; with --target-fidelity a plan beside that one
    (default: none, of snapshots 0.8)."""
    share: SomeShare = 0.95
    """Fraction of the viewpoints in which the level of a category must reach the target."""
    other_targets: tuple[SomeShare, ...] | None = None
    """Further targets to plan and measure, of the quality that leads (default: fidelity 0.8, 0.9 and 0.98;
    SSIM 0.1 below and above)."""
    budget: NotNegative = 0.0
    """Plan for the best quality within this budget instead of the target; 0: no budget."""
    budget_unit: Literal["bytes", "gpu-bytes", "count"] = "bytes"
    """Unit of the budget: bytes to transfer, bytes of GPU memory in the viewer, or Gaussians."""
    weights: dict[str, Weight] = field(default_factory=dict)
    """Weights of categories within the budget, by name (1 unless named; nothing after it: 1 for all)."""

    @property
    def quality(self) -> Literal["fidelity", "ssim"]:
        """The quality that leads: fidelity where it has a target, or nothing has."""
        ssim_alone = self.target_fidelity is None and self.target_ssim is not None
        return "ssim" if ssim_alone else "fidelity"

    @property
    def target(self) -> float:
        """Its main target."""
        given = self.target_ssim if self.quality == "ssim" else self.target_fidelity
        return 0.95 if given is None else given

    @property
    def targets(self) -> list[float]:
        """All targets of the quality that leads, ascending."""
        main = self.target
        near = (main - 0.1, main + 0.1) if self.quality == "ssim" else (0.8, 0.9, 0.98)
        others = [t for t in near if 0 < t < 1] if self.other_targets is None else self.other_targets
        return sorted({round(t, 6) for t in (main, *others)})

    @property
    def all_targets(self) -> list[tuple[Literal["fidelity", "ssim"], float]]:
        """Every (quality, target) to plan for: those of the quality that leads, then SSIM beside fidelity."""
        found: list[tuple[Literal["fidelity", "ssim"], float]] = [(self.quality, t) for t in self.targets]
        if self.quality == "fidelity" and self.target_ssim is not None:
            found.append(("ssim", round(self.target_ssim, 6)))
        return found


@dataclass(frozen=True)
class PaperConfig:
    """The paper's tables and figures."""

    view: str | None = None
    """Photo of Tables III and IV and of Fig. 4 (default: the middle one of the test views)."""
    lpips: Path | None = None
    """Folder with the LPIPS weights (default: where `sagesplat download lpips` puts them)."""
    tune_steps: Int31 = 500
    """Training steps of pruned 3DGS and of tuned compositions in Table IV."""


@dataclass(frozen=True)
class CompareConfig:
    """Baselines beside the nested levels."""

    targets: tuple[SomeShare, ...] = ()
    """SSIM targets for SAGE compositions (default: 0.6 0.7 0.8 and the targets of the run)."""
    snapshots: PositiveInt31 = 10
    """Maximum number of training snapshots to compare, evenly spaced in size."""
    shares: tuple[SomeShare, ...] = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
    """Sizes that the last snapshot is pruned to, as fractions of its Gaussians."""
    tune_steps: Annotated[int, Meta(ge=-1, le=_MOST)] = 500
    """Training steps after pruning; -1: as many as the nested levels had."""
    caps: tuple[SomeShare, ...] = (0.1, 0.2, 0.35, 0.5, 1.0)
    """Sizes of 3DGS-MCMC models, trained from the start, as fractions of the last snapshot's Gaussians."""
    budgets: Annotated[int, Meta(ge=2, le=1000)] = 12
    """Number of byte budgets that the nested levels are planned for, in geometric steps."""
    lpips: Path | None = None
    """Folder with the LPIPS weights (default: where `sagesplat download lpips` puts them)."""


@dataclass(frozen=True)
class MeasureConfig:
    """Viewpoints and metrics."""

    views: SomeViewpoints = 24
    """Number of viewpoints; of those of a file as many, evenly spread."""
    cameras: Path | None = None
    """Viewpoints of a file or a capture, instead of drawn ones: cameras.json of 3DGS, viewpoints.json,
    transforms.json, a COLMAP workspace."""
    up: str = "auto"
    """Up direction for drawn viewpoints: x, -x, y, -y, z or -z (auto: the normal of a floor, or -y)."""
    kind: Literal["auto", "object", "place"] = "auto"
    """Draw viewpoints around an object, or inside of a place (auto: by the free space)."""
    fov: Fov = 60.0
    """Field of view of drawn viewpoints along the longer side, degrees."""
    size: Annotated[int, Meta(ge=16, le=8192)] = 512
    """Longer side of the images, px; those of a file are made no larger."""
    seed: Seed = 0
    """Seed of drawn viewpoints."""
    lpips: Path | None = None
    """Folder with the LPIPS weights (default: where `sagesplat download lpips` puts them)."""


@dataclass(frozen=True)
class BundleConfig:
    """Contents of the bundle."""

    meters_per_unit: Annotated[float, Meta(ge=1e-6, le=1e6)] | None = None
    """Scale of the scene in metres per unit, for headsets (default: estimated from the height of the
    cameras)."""
    always: tuple[str, ...] = ()
    """Categories that are always shipped in full."""
    weights: dict[str, Weight] = field(default_factory=dict)
    """Weights of categories in the viewer's plans, as NAME VALUE ... (default: 1 each)."""
    single_file: bool = False
    """Write one HTML page that opens from the disk, instead of a folder for a web server."""
    chunks: Literal["stream", "spz"] | None = None
    """Format of the increments: coded streams, or SPZ files, which other viewers read too (default: that of
    the run)."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run needs to be repeated."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    masks: MasksConfig = field(default_factory=MasksConfig)
    labels: LabelsConfig = field(default_factory=LabelsConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    clean: CleanConfig = field(default_factory=CleanConfig)
    blocks: BlocksConfig = field(default_factory=BlocksConfig)
    nest: NestConfig = field(default_factory=NestConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    fuse: bool = False
    """Fuse the label images of all views through the trained Gaussians."""
    ladder: LadderKind = "nested"
    """Levels: nested (prefixes of one model), or the snapshots of training, as in the paper."""
    seed: Seed = 0
    """Seed of the random numbers."""
