"""DeepLabV2 with a ResNet backbone (Chen et al., TPAMI 2017, arXiv:1606.00915), the paper's segmenter.

Public checkpoints of this architecture are read under three schemes of parameter names (`own_name`), behind
any of the prefixes module., model., base., scale., Scale. and backbone.:

    PyTorch port  layer1.conv1.conv  layer2.block1.reduce.bn  layer2.block1.shortcut.conv  aspp.c0
    torchvision   conv1              layer1.0.bn1             layer1.0.downsample.0  layer5.conv2d_list.0
    Caffe         conv1              bn2a_branch2a            res2a_branch1          fc1_voc12_c0

All of them put the stride of a stage into its first 1 x 1 convolution, as Caffe's ResNet does, and want BGR
in 0 ... 255 less a mean.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import Image
from torch import Tensor, nn
from torch.nn import functional as F

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import BackendUnavailable, LabelError
from sagesplat.core.extras import install
from sagesplat.core.memory import ran_out
from sagesplat.io.tensors import read_tensors
from sagesplat.segment import coco
from sagesplat.segment.crf import refine
from sagesplat.segment.hub import torch_device
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.segmenters import (
    Segmented,
    SegmenterFactory,
    arg_max_resized,
    existing_file,
    group_classes,
)
from sagesplat.segment.taxonomies import to_coco, vocabulary

Head = Literal["coco-stuff", "voc"]

HEADS: Mapping[Head, int] = {"coco-stuff": 182, "voc": 21}  # outputs
MEAN_BGR = (104.008, 116.669, 122.675)  # what the checkpoints' inputs have subtracted, of 0 ... 255
SCALES = (1.0, 0.75, 0.5)
SIZE = 513  # pixels of a photo's longer side: what the checkpoints were tested at
RATES = (6, 12, 18, 24)  # of the convolutions in the head: ASPP-L in the paper
BLOCKS = (3, 4, 23, 3)  # ResNet-101

# COCO-Stuff numbers 1 ... 182 and output c is number c + 1. COCO never annotated these eleven, so their
# outputs were never trained: street sign, hat, shoe, eye glasses, plate, mirror, window, desk, door,
# blender, hair brush.
COCO_STUFF_UNUSED = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83, 91)

# VOC's classes 1 ... 20 under COCO's names; output 0 is the background.
_VOC = (
    *("airplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow", "dining table"),
    *("dog", "horse", "motorcycle", "person", "potted plant", "sheep", "couch", "train", "tv"),
)


class Bottleneck(nn.Module):
    """Three convolutions around a shortcut (He et al. 2016), the middle one atrous."""

    def __init__(self, inputs: int, width: int, stride: int, dilation: int, project: bool):
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 1, stride, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = None
        if project:
            shortcut = nn.Conv2d(inputs, 4 * width, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(4 * width))

    def forward(self, x: Float[Tensor, "B I h w"]) -> Float[Tensor, "B O h2 w2"]:
        """The block's features."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return F.relu(self.bn3(self.conv3(x)) + shortcut)


class DeepLabV2(nn.Module):
    """The network at one scale: BGR in 0 ... 255 less `MEAN_BGR` in, logits at an eighth of the size out.

    `blocks` and `width` are those of the ResNet: blocks of each of four stages, channels of the first.
    Its parameters have torchvision's names, the head's are aspp.0 ... aspp.3. In eval mode, as loaded, batch
    norm is frozen, also under fine-tuning in the paper.
    """

    def __init__(self, num_classes: int, blocks: Sequence[int] = BLOCKS, width: int = 64):
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.pool = nn.MaxPool2d(3, 2, padding=1, ceil_mode=True)
        first, second, third, fourth = blocks
        self.layer1 = _stage(width, width, first, stride=1, dilation=1)
        self.layer2 = _stage(4 * width, 2 * width, second, stride=2, dilation=1)
        self.layer3 = _stage(8 * width, 4 * width, third, stride=1, dilation=2)
        self.layer4 = _stage(16 * width, 8 * width, fourth, stride=1, dilation=4)
        heads = [nn.Conv2d(32 * width, num_classes, 3, padding=r, dilation=r) for r in RATES]
        self.aspp = nn.ModuleList(heads)
        for head in heads:  # the paper's initialisation
            nn.init.normal_(head.weight, std=0.01)
            nn.init.zeros_(head.bias)  # type: ignore

    @property
    def num_classes(self) -> int:
        """How many logits a pixel has."""
        return int(self.aspp[0].bias.shape[0])  # type: ignore

    def forward(self, x: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """Logits of each class at output stride 8."""
        x = self.pool(F.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return torch.stack([head(x) for head in self.aspp]).sum(0)


def _stage(inputs: int, width: int, blocks: int, *, stride: int, dilation: int) -> nn.Sequential:
    first = Bottleneck(inputs, width, stride, dilation, project=True)
    others = (Bottleneck(4 * width, width, 1, dilation, project=False) for _ in range(blocks - 1))
    return nn.Sequential(first, *others)


def fuse_scales(model: nn.Module, x: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
    """The largest logit over the input at all `SCALES` (Sec. 4.1.2), at the size of the first one's.

    Bilinear with align_corners=False, to which the PyTorch port trained its checkpoints.
    """
    fused = model(x)
    for scale in SCALES[1:]:
        size = [max(1, int(scale * length)) for length in x.shape[2:]]
        logits = model(x if size == list(x.shape[2:]) else _resize(x, size))
        fused = torch.maximum(fused, _resize(logits, fused.shape[2:]))
    return fused


def _resize(x: Float[Tensor, "B C h w"], size: Sequence[int]) -> Float[Tensor, "B C H W"]:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)


def load_deeplabv2(path: Path, *, blocks: Sequence[int] = BLOCKS, width: int = 64) -> DeepLabV2:
    """A network with the weights of a public checkpoint, in eval mode. Raises LabelError.

    `path` is a state dict as torch saves it, bare or as "state_dict" or "model" of a dict, or safetensors.
    Pickles with anything but tensors in them are refused. The number of outputs says which of `HEADS` it has.
    """
    found = _renamed(path, _read_weights(path))
    model = DeepLabV2(HEADS[_head_of(path, found)], blocks, width)
    wanted = {name: p for name, p in model.state_dict().items() if not name.endswith(_COUNTER)}
    _check(path, found, wanted)
    model.load_state_dict({n: found[n].float() for n in wanted}, strict=False)  # but for the counters
    return model.eval()


_COUNTER = "num_batches_tracked"  # of training; old checkpoints have none
_PREFIX = re.compile(r"^(?:(?:module|model|base|scale|Scale|backbone)\.)+")
_PARTS = {"reduce": 1, "conv3x3": 2, "increase": 3, "2a": 1, "2b": 2, "2c": 3}  # convolution of a block


def _of_port(m: re.Match[str]) -> str:
    return _of_block(int(m[1]) - 1, int(m[2]) - 1, m[3], m[4] == "bn")


def _of_caffe(m: re.Match[str]) -> str:
    block = int(m[3][1:]) if len(m[3]) > 1 else "abcdef".index(m[3])
    return _of_block(int(m[2]) - 1, block, m[4], m[1] != "res")


def _of_block(stage: int, block: int, part: str, bn: bool) -> str:
    k = _PARTS.get(part)
    module = f"downsample.{int(bn)}" if k is None else f"{'bn' if bn else 'conv'}{k}"
    return f"layer{stage}.{block}.{module}."


_RENAMES = [
    (re.compile(r"^layer1\.conv1\.conv\."), "conv1."),
    (re.compile(r"^(?:layer1\.conv1\.bn|bn_conv1|scale_conv1)\."), "bn1."),
    (re.compile(r"^layer(\d)\.block(\d+)\.(reduce|conv3x3|increase|shortcut|proj)\.(conv|bn)\."), _of_port),
    (re.compile(r"^(res|bn|scale)(\d)([a-f]|b\d+)_branch(1|2a|2b|2c)\."), _of_caffe),
    (
        re.compile(r"^(?:aspp\.(?:stages\.)?c|(?:layer5|classifier)\.conv2d_list\.|fc1_\w+_c)(\d)\."),
        r"aspp.\1.",
    ),
]


def own_name(name: str) -> str:
    """The name that a parameter of a public checkpoint has in `DeepLabV2`; others stay as they are."""
    name = _PREFIX.sub("", name)
    for pattern, own in _RENAMES:
        name = pattern.sub(own, name)
    return name


def _renamed(path: Path, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for name, value in weights.items():
        own = own_name(name)
        if own in found:
            raise LabelError(f"{path}: {name} is there twice, under other names; save one network alone")
        if not own.endswith(_COUNTER):
            found[own] = value
    return found


def _read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by their names in it."""
    try:
        if path.suffix == ".safetensors":
            content = _read_safetensors(path)
        else:
            with path.open("rb") as file:
                content = read_tensors(file)
    except FileNotFoundError:
        raise LabelError(f"{path}: no such file; name a checkpoint of DeepLabV2") from None
    except BackendUnavailable:
        raise
    except Exception as error:  # pickle, zip and safetensors have a class for each kind of damage
        if ran_out(error):
            raise
        reason = str(error).strip().partition("\n")[0][:120]
        raise LabelError(f"{path}: not a file of tensors ({reason}); save the bare state dict") from None
    for key in ("state_dict", "model"):
        content = content.get(key, content) if isinstance(content, dict) else content
    if not (isinstance(content, dict) and content and all(isinstance(v, Tensor) for v in content.values())):
        raise LabelError(f"{path}: holds no state dict; save the bare state dict of the network")
    return content


def _read_safetensors(path: Path) -> Any:
    try:
        from safetensors.torch import load_file
    except ImportError:
        raise BackendUnavailable(f"{path.name} needs safetensors; {install('sagesplat[hf]')}") from None
    if not path.is_file():
        raise FileNotFoundError(path)
    return load_file(path)


def _head_of(path: Path, found: Mapping[str, Tensor]) -> Head:
    """The head that has as many outputs as the weights, the larger where they do not say; else LabelError."""
    outputs = found["aspp.0.bias"].numel() if "aspp.0.bias" in found else max(HEADS.values())
    for head, count in HEADS.items():
        if count == outputs:
            return head
    known = " or ".join(f"{count} ({head})" for head, count in HEADS.items())
    raise LabelError(f"{path}: {outputs} outputs, but {known} are known; take another checkpoint")


def _check(path: Path, found: dict[str, Tensor], wanted: Mapping[str, Tensor]) -> None:
    """LabelError where names or shapes differ."""
    cure = "take a checkpoint of DeepLabV2 with this ResNet"
    for kind, names in (("lacks", wanted.keys() - found.keys()), ("also has", found.keys() - wanted.keys())):
        if names:
            listed = ", ".join(sorted(names)[:3]) + (", ..." if len(names) > 3 else "")
            raise LabelError(f"{path}: {kind} {len(names)} parameters ({listed}); {cure}")
    for name, value in wanted.items():
        if found[name].shape != value.shape:
            shapes = f"{list(found[name].shape)}, not {list(value.shape)}"
            raise LabelError(f"{path}: {name} is of shape {shapes}; {cure}")
        if not found[name].isfinite().all():
            raise LabelError(f"{path}: {name} has values that are not finite; download it again")


@dataclass(frozen=True, eq=False)
class HeadClasses:
    """What a network's outputs mean."""

    outputs: tuple[int, ...]  # those that were trained; the others are ignored
    label_ids: tuple[int | None, ...]  # category id of each of them, None = unlabelled

    @property
    def taxonomy(self) -> Taxonomy:
        """The categories under COCO's names."""
        return Taxonomy({i: coco.NAMES[i] for i in sorted({i for i in self.label_ids if i is not None})})


def head_classes(head: Head) -> HeadClasses:
    """COCO panoptic's category of each output of a head; several outputs may have the same."""
    if head == "voc":
        by_name = {name: label_id for label_id, name in coco.NAMES.items()}
        return HeadClasses(tuple(range(HEADS[head])), (None, *(by_name[name] for name in _VOC)))
    outputs = tuple(c for c in range(HEADS[head]) if c + 1 not in COCO_STUFF_UNUSED)
    return HeadClasses(outputs, tuple(to_coco(vocabulary("coco-stuff"), "coco-stuff")))


class DeepLabV2Segmenter:
    """The network with what its outputs mean: a `segmenters.Segmenter`.

    A photo is resized to `SIZE` pixels along its longer side and seen at all `SCALES`. Probabilities of
    outputs of one category are summed before the label image is chosen. With `crf`, `crf.refine` has them
    first, at the size that the network sees. `device` is auto, cpu, cuda or cuda:N.
    """

    def __init__(self, model: DeepLabV2, classes: HeadClasses, *, crf: bool = False, device: str = "cpu"):
        self.taxonomy, self.crf = classes.taxonomy, crf
        self._device = torch_device(device)
        self._model = model.eval().to(self._device)
        self._ids, rows = group_classes(classes.label_ids)
        self._outputs = [np.array(classes.outputs)[rows == k] for k in range(len(self._ids))]

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[Segmented]:
        """The label image of each photo."""
        return [self._segment(photo) for photo in photos]

    @torch.inference_mode()
    def _segment(self, photo: UInt8[np.ndarray, "H W 3"]) -> Segmented:
        small = _to_size(photo)
        ranks = self._scores(small)
        if self.crf:
            ranks = _refine(F.softmax(_resize(ranks, small.shape[:2]), 1)[0].numpy(), small)
        else:
            ranks = ranks[0].numpy()
        height, width = photo.shape[:2]
        return Segmented(self._ids[arg_max_resized(ranks, height, width)])

    def _scores(self, photo: UInt8[np.ndarray, "H W 3"]) -> Float32[Tensor, "1 K h w"]:
        """Log of each category's probability, but for a constant: log-sum-exp of its outputs."""
        bgr = torch.from_numpy(photo[..., ::-1].astype(np.float32)) - torch.tensor(MEAN_BGR)
        logits = fuse_scales(self._model, bgr.permute(2, 0, 1)[None].to(self._device)).cpu()
        return torch.stack([logits[:, outputs].logsumexp(1) for outputs in self._outputs], 1)


def _to_size(photo: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The photo with a longer side of `SIZE` pixels (bilinear, antialiased where it shrinks)."""
    height, width = photo.shape[:2]
    scale = SIZE / max(height, width)
    new = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.array(Image.fromarray(photo).resize(new, Image.Resampling.BILINEAR))


def _refine(
    p: Float32[np.ndarray, "K h w"], photo: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "K h w"]:
    """`crf.refine` among the categories that win anywhere: the others would cost time and hardly win."""
    rows = np.unique(p.argmax(0))
    refined = np.zeros_like(p)
    refined[rows] = refine(p[rows] / p[rows].sum(0), photo)
    return refined


def _settings(config: MasksConfig) -> dict[str, Any]:
    model = existing_file(config.model, "--segmenter deeplabv2 needs --model CHECKPOINT.pth")
    return {"model": model, "crf": config.crf}


def _load(config: MasksConfig, device: str, threads: int, warn: Callable[[str], None]) -> DeepLabV2Segmenter:
    network = load_deeplabv2(Path(config.model or ""))
    head: Head = next(head for head, outputs in HEADS.items() if outputs == network.num_classes)
    return DeepLabV2Segmenter(network, head_classes(head), crf=config.crf, device=device)


FACTORY = SegmenterFactory(_settings, _load, (".pth", ".pt", ".safetensors"))
