from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from sagesplat.core.errors import LabelError
from sagesplat.segment import deeplabv2
from sagesplat.segment.deeplabv2 import (
    COCO_STUFF_UNUSED,
    HEADS,
    MEAN_BGR,
    RATES,
    DeepLabV2,
    DeepLabV2Segmenter,
    HeadClasses,
    fuse_scales,
    head_classes,
    load_deeplabv2,
    own_name,
)
from sagesplat.segment.segmenters import Segmenter

SMALL: dict[str, Any] = {"blocks": (1, 2, 3, 1), "width": 2}


def small(num_classes: int = 21, seed: int = 0) -> DeepLabV2:
    """A network of few channels with statistics as if it had been trained."""
    torch.manual_seed(seed)
    model = DeepLabV2(num_classes, **SMALL).eval()
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, std=0.1)  # type: ignore[arg-type]
            nn.init.uniform_(module.running_var, 0.5, 2)  # type: ignore[arg-type]
            nn.init.uniform_(module.weight, 0.5, 2)
    return model


class Fixed(DeepLabV2):
    """Answers with the same logits everywhere and keeps what it was asked."""

    def __init__(self, logits: list[float]):
        super().__init__(len(logits), (1, 1, 1, 1), 1)
        self.logits, self.seen = torch.tensor(logits), []

    def forward(self, x: Tensor) -> Tensor:
        self.seen.append(x)
        h, w = ((length + 7) // 8 for length in x.shape[2:])
        return self.logits[None, :, None, None].expand(len(x), -1, h, w)


# the network


@pytest.mark.parametrize(
    ("size", "expected"),
    [((1, 1), (1, 1)), ((2, 9), (1, 2)), ((321, 17), (41, 3))],
)
def test_output_stride_is_eight(size: tuple[int, int], expected: tuple[int, int]) -> None:
    with torch.inference_mode():
        assert small()(torch.zeros(2, 3, *size)).shape == (2, 21, *expected)


def test_resnet_101_has_its_parameters() -> None:
    model = DeepLabV2(182)
    resnet = 42_500_160  # torchvision's 44,549,160 less the 2,049,000 of its classifier
    assert sum(p.numel() for p in model.parameters()) == resnet + 4 * (9 * 2048 + 1) * 182
    assert model.num_classes == 182
    convolutions = [m for m in model.modules() if isinstance(m, nn.Conv2d)]
    assert len(convolutions) == 1 + 3 * 33 + 4 + 4


@pytest.mark.parametrize("axis", [0, 1])
def test_receptive_field_is_what_the_dilations_say(axis: int) -> None:
    blocks, output = (2, 1, 2, 1), 38
    model = DeepLabV2(1, blocks, 1).double().eval()
    model.add_module(
        "pool", nn.AvgPool2d(3, 2, padding=1, ceil_mode=True)
    )  # its gradient reaches all of the window
    for p in model.parameters():
        p.data.abs_()  # nothing is cut off by a ReLU
    shape = [1, 3, 3, 3]
    shape[2 + axis] = 700
    x = torch.ones(shape, dtype=torch.float64, requires_grad=True)
    model(x).flatten()[output].backward()
    assert x.grad is not None
    reached = x.grad.sum((0, 1, 3 - axis)).nonzero().flatten()
    by_dilation = zip((1, 2, 4, max(RATES)), (*blocks[1:], 1), strict=True)
    radius = sum(dilation * count for dilation, count in by_dilation)  # outputs, at stride 8
    low, high = 2 * (output - radius) - blocks[0], 2 * (output + radius) + blocks[0]  # at stride 4
    low, high = 2 * low - 1, 2 * high + 1  # the pool, at stride 2
    assert [int(reached.min()), int(reached.max())] == [2 * low - 3, 2 * high + 3]


@pytest.mark.parametrize("branch", range(4))
def test_atrous_rates_of_the_head(branch: int) -> None:
    head, rate = small(1).aspp[branch], RATES[branch]
    nn.init.ones_(head.weight)  # type: ignore[arg-type]
    x = torch.zeros(1, 64, 61, 61)
    x[0, 0, 30, 30] = 1
    rows, columns = head(x)[0, 0].nonzero().T
    steps = [30 - rate, 30, 30 + rate]
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(r, c) for r in steps for c in steps]


def bilinear(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear resampling with pixel centres at + 0.5, the borders repeated."""
    for axis, length in ((1, height), (2, width)):
        at = (np.arange(length) + 0.5) * image.shape[axis] / length - 0.5
        at = at.clip(0, image.shape[axis] - 1)
        low = np.floor(at).astype(int)
        high = np.minimum(low + 1, image.shape[axis] - 1)
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(3)])
        image = image.take(low, axis) * (1 - share) + image.take(high, axis) * share
    return image


def test_scales_are_fused_by_their_maximum() -> None:
    model, photo = small(4).double(), np.random.default_rng(0).normal(size=(3, 45, 66))

    def logits(image: np.ndarray) -> np.ndarray:
        return model(torch.from_numpy(image)[None])[0].detach().numpy()

    whole, three_quarters, half = (
        logits(photo),
        logits(bilinear(photo, 33, 49)),
        logits(bilinear(photo, 22, 33)),
    )
    expected = [whole, *(bilinear(part, *whole.shape[1:]) for part in (three_quarters, half))]
    with torch.inference_mode():
        fused = fuse_scales(model, torch.from_numpy(photo)[None])[0].numpy()
    np.testing.assert_allclose(fused, np.max(expected, axis=0), rtol=1e-9)
    assert 0 < (fused == whole).mean() < 1  # more than one scale counts


def load(path: Path) -> DeepLabV2:
    return load_deeplabv2(path, **SMALL)


def weights(num_classes: int = 21) -> dict[str, Tensor]:
    return {n: v for n, v in small(num_classes).state_dict().items() if "num_batches" not in n}


@pytest.mark.parametrize(
    ("public", "own"),
    [
        ("base.layer1.conv1.conv.weight", "conv1.weight"),
        ("base.layer1.conv1.bn.running_mean", "bn1.running_mean"),
        ("base.layer2.block1.reduce.conv.weight", "layer1.0.conv1.weight"),
        ("base.layer4.block23.conv3x3.bn.bias", "layer3.22.bn2.bias"),
        ("base.layer5.block1.shortcut.conv.weight", "layer4.0.downsample.0.weight"),
        ("base.aspp.c3.bias", "aspp.3.bias"),
        ("Scale.layer5.conv2d_list.2.weight", "aspp.2.weight"),
        ("module.layer3.22.conv3.weight", "layer3.22.conv3.weight"),
        ("res2a_branch2a.weight", "layer1.0.conv1.weight"),
        ("res2c_branch2c.weight", "layer1.2.conv3.weight"),
        ("bn5a_branch1.running_var", "layer4.0.downsample.1.running_var"),
        ("bn_conv1.running_var", "bn1.running_var"),
        ("scale.layer5.block1.proj.bn.weight", "layer4.0.downsample.1.weight"),
        ("scale.aspp.stages.c0.weight", "aspp.0.weight"),
        ("res4b22_branch2b.weight", "layer3.22.conv2.weight"),
        ("scale3b3_branch2a.bias", "layer2.3.bn1.bias"),
        ("fc1_coco_c1.bias", "aspp.1.bias"),
        ("something.else", "something.else"),
    ],
)
def test_names(public: str, own: str) -> None:
    assert own_name(public) == own


@pytest.mark.parametrize("form", ["legacy", "state_dict", "model", "half", "safetensors", "counted"])
def test_each_form_of_file_loads(form: str, tmp_path: Path) -> None:
    state, path = weights(), tmp_path / ("x.safetensors" if form == "safetensors" else "x.pth")
    if form == "safetensors":
        save_file(state, path)
    elif form == "half":
        torch.save({n: v.half() for n, v in state.items()}, path)
    elif form == "counted":
        torch.save(small().state_dict(), path)
    else:
        named = {f"module.base.{n}": v for n, v in state.items()}
        content = {form: named, "epoch": 3} if form != "legacy" else state
        torch.save(content, path, _use_new_zipfile_serialization=form != "legacy")
    found = load(path).state_dict()
    assert all(torch.allclose(found[n], v, atol=2e-3) for n, v in state.items())
    assert all(v.dtype == torch.float32 for n, v in found.items() if "num_batches" not in n)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"layer3.1.conv2.weight": None}, r"lacks 1 parameters \(layer3\.1\.conv2\.weight\)"),
        ({"layer3.3.conv1.weight": torch.ones(3)}, r"also has 1 parameters \(layer3\.3\.conv1\.weight\)"),
        ({"layer1.0.conv2.weight": torch.ones(2, 2, 1, 1)}, r"of shape \[2, 2, 1, 1\], not \[2, 2, 3, 3\]"),
        (
            {"conv1.weight": torch.full((2, 3, 7, 7), torch.nan)},
            r"conv1\.weight has values that are not finite",
        ),
        ({"module.conv1.weight": torch.zeros(1)}, r"module\.conv1\.weight is there twice"),
        (weights(7), r"7 outputs, but 182 \(coco-stuff\) or 21 \(voc\) are known"),
    ],
)
def test_what_cannot_be_loaded_is_one_line(changes: dict[str, Any], says: str, tmp_path: Path) -> None:
    state = {name: value for name, value in (weights() | changes).items() if value is not None}
    torch.save(state, path := tmp_path / "weights.pth")
    with pytest.raises(LabelError, match=says) as caught:
        load(path)
    assert str(caught.value).startswith(str(path))


# what the outputs mean


def test_voc() -> None:
    classes = head_classes("voc")
    names = ["" if i is None else classes.taxonomy.names[i] for i in classes.label_ids]
    assert len(names) == HEADS["voc"]
    assert names[0] == ""  # the background
    assert [names[i] for i in (1, 9, 11, 14, 15, 16, 18, 20)] == [
        *("airplane", "chair", "dining table", "motorcycle", "person", "potted plant", "couch", "tv")
    ]


def test_coco_stuff() -> None:
    classes = head_classes("coco-stuff")
    assert len(classes.outputs) == len(classes.label_ids) == 171
    by_number = {c + 1: i for c, i in zip(classes.outputs, classes.label_ids, strict=True)}
    assert not set(COCO_STUFF_UNUSED) & by_number.keys()
    assert all(by_number[i] == i for i in range(1, 91) if i not in COCO_STUFF_UNUSED)  # things
    assert [by_number[i] for i in (106, 124, 140, 157, 169, 182)] == [187, 193, 191, 187, 184, by_number[182]]
    assert classes.taxonomy.names[187] == "sky-other-merged"


# the segmenter


def test_input_is_bgr_less_the_mean_at_the_tested_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deeplabv2, "SIZE", 64)
    model = Fixed([0.0] * 21)
    photo = np.full((40, 80, 3), (10, 20, 30), np.uint8)
    DeepLabV2Segmenter(model, head_classes("voc"))([photo])
    assert [tuple(x.shape) for x in model.seen] == [(1, 3, 32, 64), (1, 3, 24, 48), (1, 3, 16, 32)]
    expected = torch.tensor([30, 20, 10]) - torch.tensor(MEAN_BGR)
    torch.testing.assert_close(model.seen[0][0, :, 5, 5], expected)


@pytest.mark.parametrize("crf", [False, True])
def test_outputs_of_one_category_are_summed(crf: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deeplabv2, "SIZE", 12)
    ids = (17, 18, 17, None)
    model = Fixed([1.0, 1.5, 1.0, 0.0, 9.0])  # the last one was never trained
    segmenter = DeepLabV2Segmenter(model, HeadClasses((0, 1, 2, 3), ids), crf=crf)
    (found,) = segmenter([np.full((9, 12, 3), 90, np.uint8)])
    assert (found.label_ids == 17).all()
    assert found.label_ids.dtype == np.int16


def test_background_is_unlabelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deeplabv2, "SIZE", 8)
    segmenter = DeepLabV2Segmenter(Fixed([9.0] + [0.0] * 20), head_classes("voc"))
    (found,) = segmenter([np.zeros((8, 8, 3), np.uint8)])
    assert (found.label_ids == -1).all()


@pytest.mark.parametrize("crf", [False, True])
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (23, 37)])
def test_photos_of_any_size(shape: tuple[int, int], crf: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deeplabv2, "SIZE", 33)
    segmenter: Segmenter = DeepLabV2Segmenter(small(), head_classes("voc"), crf=crf)
    grey = np.repeat(np.random.default_rng(0).integers(0, 256, (*shape, 1), np.uint8), 3, axis=2)
    first, second = segmenter([grey, np.zeros((5, 4, 3), np.uint8)])
    assert first.label_ids.shape == shape
    assert second.label_ids.shape == (5, 4)
    assert set(np.unique(first.label_ids).tolist()) <= {-1, *segmenter.taxonomy.names}
