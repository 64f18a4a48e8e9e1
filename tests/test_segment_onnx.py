import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from sagesplat.core.errors import BackendUnavailable, LabelError
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.segment.onnx import OnnxSegmenter, read_classes, to_input
from sagesplat.segment.segmenters import arg_max_resized

SHARED = Path(__file__).resolve().parents[2] / "shared"
CLASSES = {"classes": ["red", "sky", "other"], "coco_panoptic": {"red": 500, "sky": 187, "other": None}}
FLOAT, INT64, INT_ATTRIBUTE, INTS_ATTRIBUTE = 1, 7, 2, 7


def field(number, value):
    """One field of a protobuf message: a varint, a length-delimited one for bytes and text."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def varint(value):
    low, rest = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + varint(rest) if rest else bytes([low])


def value_info(name, shape, kind=FLOAT):
    dims = b"".join(field(1, field(1 if isinstance(d, int) else 2, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def node(kind, inputs, output, **ints):
    attributes = b"".join(
        field(5, field(1, name) + b"".join(field(8, i) for i in values) + field(20, INTS_ATTRIBUTE))
        for name, values in ints.items()
    )
    return field(1, b"".join(field(1, i) for i in inputs) + field(2, output) + field(4, kind) + attributes)


def arg_max_node():
    """The number of the largest channel, [1, h, w]."""
    attributes = (("axis", 1), ("keepdims", 0))
    fields = b"".join(
        field(5, field(1, name) + field(3, i) + field(20, INT_ATTRIBUTE)) for name, i in attributes
    )
    return field(1, field(1, "logits") + field(2, "numbers") + field(4, "ArgMax") + fields)


def write_model(path, weights, size=(16, 32), channels_first=True, arg_max=False):
    """A real ONNX model: the mean of each 4 x 4 block, then one linear map of the channels per class."""
    weights = np.array(weights, np.float32)
    x, classes = "photo", len(weights)
    nodes = b""
    if not channels_first:
        nodes, x = node("Transpose", ["photo"], "planes", perm=(0, 3, 1, 2)), "planes"
    nodes += node("AveragePool", [x], "pooled", kernel_shape=(4, 4), strides=(4, 4))
    nodes += node("Conv", ["pooled", "weights"], "logits", kernel_shape=(1, 1))
    tensor = b"".join(field(1, d) for d in (classes, 3, 1, 1)) + field(2, FLOAT) + field(8, "weights")
    tensor += field(9, struct.pack(f"<{weights.size}f", *weights.ravel()))
    shape = (1, 3, *size) if channels_first else (1, *size, 3)
    out = (1, classes, *(s // 4 if isinstance(s, int) else s for s in size))
    graph = nodes + field(2, "blocks") + field(5, tensor)
    result = value_info("logits", out)
    if arg_max:
        graph = arg_max_node().join([nodes, b""]) + graph[len(nodes) :]
        result = value_info("numbers", (1, *out[2:]), INT64)
    graph += field(11, value_info("photo", shape)) + field(12, result)
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(2, 13)))
    return path


@pytest.fixture
def files(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs sagesplat[onnx]")
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    return write_model(tmp_path / "model.onnx", np.eye(3)[[0, 2, 1]]), tmp_path / "classes.json"


def red_and_blue(height=32, width=64):
    photo = np.zeros((height, width, 3), np.uint8)
    photo[:, : width // 2, 0] = 255
    photo[:, width // 2 :, 2] = 255
    return photo


@pytest.mark.parametrize("channels_first", [True, False])
def test_a_model_segments_photos(tmp_path, files, channels_first):
    model = write_model(tmp_path / "model.onnx", np.eye(3)[[0, 2, 1]], channels_first=channels_first)
    photo = red_and_blue()
    photo[16:, 32:] = (0, 255, 0)
    (found,) = OnnxSegmenter(model, files[1])([photo])
    label_ids = found.label_ids
    assert label_ids.shape == (32, 64)
    assert label_ids.dtype == np.int16
    expected = np.full((32, 64), 500)
    expected[:16, 32:], expected[16:, 32:] = 187, -1
    sure = np.ones((32, 64), bool)
    sure[13:19, 29:35] = False  # where three regions meet, bilinear logits round the corners
    np.testing.assert_array_equal(label_ids[sure], expected[sure])


def test_classes_of_one_category_are_summed(tmp_path, files):
    ids = {"red": 500, "sky": 187, "other": 187}
    (tmp_path / "c.json").write_text(json.dumps(CLASSES | {"coco_panoptic": ids, "mean": 0, "std": 1}))
    model = write_model(tmp_path / "m.onnx", [[0.5, 0, 0], [0, 0, 0.2], [0, 0.1, 0]])
    (found,) = OnnxSegmenter(model, tmp_path / "c.json")([np.full((8, 16, 3), 255, np.uint8)])
    # the largest logit is red's, but the two others have more together
    np.testing.assert_array_equal(found.label_ids, np.full((8, 16), 187))


def test_a_model_that_ends_in_an_arg_max(tmp_path, files):
    model = write_model(tmp_path / "m.onnx", np.eye(3)[[0, 2, 1]], arg_max=True)
    (found,) = OnnxSegmenter(model, files[1])([red_and_blue()])
    np.testing.assert_array_equal(found.label_ids, [[500] * 32 + [187] * 32] * 32)
    (tmp_path / "c.json").write_text(json.dumps({"classes": ["a", "b"], "coco_panoptic": {"a": 1, "b": 2}}))
    write_model(model, [[0, 0, 0], [0, 0, 0], [9, 9, 9]], arg_max=True)
    with pytest.raises(LabelError, match="up to 2, but 2 classes are listed"):
        OnnxSegmenter(model, tmp_path / "c.json")([np.full((32, 64, 3), 255, np.uint8)])


def test_classes_of_a_vocabulary(tmp_path):
    path = tmp_path / "c.json"
    content = {"classes": ["wall", "sky", "runway"], "vocabulary": "ade20k", "coco_panoptic": {"runway": 149}}
    path.write_text(json.dumps(content))
    classes = read_classes(path)
    assert classes.taxonomy.names[187] == "sky-other-merged"
    assert classes.label_ids[1:].tolist() == [187, 149]
    path.write_text(json.dumps(content | {"vocabulary": "pascal"}))
    with pytest.raises(LabelError, match="take one of coco, coco-stuff, ade20k, cityscapes"):
        read_classes(path)


def test_input_and_output_are_resampled_bilinearly(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(CLASSES))
    photo = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3) * 10
    x = to_input(photo, 2, 4, read_classes(tmp_path / "c.json"))
    np.testing.assert_allclose(x, photo / 127.5 - 1, atol=1e-6)
    (tmp_path / "c.json").write_text(json.dumps(CLASSES | {"mean": [0.4, 0.5, 0.6], "std": 0.2}))
    x = to_input(photo, 2, 4, read_classes(tmp_path / "c.json"))
    np.testing.assert_allclose(x, (photo / 255 - [0.4, 0.5, 0.6]) / 0.2, atol=1e-5)
    assert to_input(photo, 5, 3, read_classes(tmp_path / "c.json")).shape == (5, 3, 3)
    # class 1 overtakes class 0 where 3 t = 1 between the centres of two coarse pixels
    logits = np.array([[[1.0, 1.0]], [[0.0, 3.0]]], np.float32)
    classes = arg_max_resized(logits, 2, 200)
    assert classes.tolist() == [[0] * 83 + [1] * 117] * 2  # 50 + 100 / 3 = 83.3


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "no such file"),
        ({"classes": ["sky"], "coco_panoptic": {}}, "not of the form .*no category of 'sky'"),
        ({"classes": ["sky"], "coco_panoptic": {"sky": 70000}}, "outside 0"),
        (CLASSES | {"std": 0}, "std: expected float >= 1e-30"),
        ({"classes": ["what"], "vocabulary": "coco"}, "names no label"),
    ],
)
def test_unusable_classes(tmp_path, content, complaint):
    if content is not None:
        (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(LabelError, match=complaint):
        read_classes(tmp_path / "c.json")


def test_unusable_models(tmp_path, files):
    _, classes = files
    cases = [
        (tmp_path / "none.onnx", "no such file"),
        (classes, "no model that onnxruntime can load"),
        (write_model(tmp_path / "open.onnx", np.eye(3), size=("height", "width")), "in fixed size is needed"),
        (write_model(tmp_path / "two.onnx", np.eye(3)[:2]), "3 classes are listed"),
    ]
    for path, complaint in cases:
        with pytest.raises(LabelError, match=complaint) as caught:
            OnnxSegmenter(path, classes)([red_and_blue()])
        assert str(path) in str(caught.value)


def attribute(name, number, value, kind):
    return field(5, field(1, name) + field(number, value) + field(20, kind))


def model_of(path, nodes, inputs=(("photo", (1, 3, 16, 32), FLOAT),), outputs=(), tensors=b""):
    """A model of nodes, with inputs and outputs of (name, shape, kind)."""
    graph = nodes + field(2, "graph") + tensors
    graph += b"".join(field(11, value_info(*entry)) for entry in inputs)
    graph += b"".join(field(12, value_info(*entry)) for entry in outputs)
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(2, 13)))
    return path


LOGITS = ("logits", (1, 3, 16, 32), FLOAT)


@pytest.mark.parametrize(
    ("nodes", "output"),
    [
        (b"", None),
        (node("Flatten", ["photo"], "logits"), ("logits", (1, 1536), FLOAT)),
        (node("Transpose", ["photo"], "logits", perm=(2, 1, 0, 3)), ("logits", (16, 3, 1, 32), FLOAT)),
        (node("Sqrt", ["photo"], "logits"), LOGITS),  # NaN
    ],
)
def test_outputs_that_are_no_label_scores(tmp_path, files, nodes, output):
    model = model_of(tmp_path / "m.onnx", nodes, outputs=[output] if output else [])
    with pytest.raises(LabelError, match=r"m\.onnx: "):
        OnnxSegmenter(model, files[1])([red_and_blue()])


def test_an_output_too_large_is_refused_before_it_is_made(tmp_path, files):
    sizes = field(
        5,
        field(1, 4) + field(2, INT64) + field(8, "sizes") + field(9, struct.pack("<4q", 1, 3, 2**20, 2**20)),
    )
    nodes = node("Expand", ["photo", "sizes"], "logits")
    inputs = [("photo", (1, 3, 1, 1), FLOAT)]
    model = model_of(tmp_path / "m.onnx", nodes, inputs, [("logits", (1, 3, 2**20, 2**20), FLOAT)], sizes)
    with pytest.raises(LabelError, match="up to 536,870,912 of them"):
        OnnxSegmenter(model, files[1])


def test_a_loop_that_never_ends_is_stopped(tmp_path, files, capfd):
    body = node("Identity", ["go"], "go_on") + node("Relu", ["x"], "y") + field(2, "body")
    for name, shape, kind in (("i", (), INT64), ("go", (), 9), ("x", LOGITS[1], FLOAT)):
        body += field(11, value_info(name, shape, kind))
    body += field(12, value_info("go_on", (), 9)) + field(12, value_info("y", LOGITS[1]))
    loop = b"".join(field(1, name) for name in ("", "yes", "photo")) + field(2, "logits") + field(4, "Loop")
    yes = field(5, field(2, 9) + field(8, "yes") + field(9, b"\x01"))
    nodes = field(1, loop + attribute("body", 6, body, 5))
    model = model_of(tmp_path / "m.onnx", nodes, outputs=[LOGITS], tensors=yes)
    with pytest.raises(LabelError, match=r"m\.onnx: no answer within 0\.3 s; take another network"):
        OnnxSegmenter(model, files[1], time_limit=0.3)([red_and_blue()])
    assert capfd.readouterr() == ("", "")
    assert OnnxSegmenter(*files, time_limit=600)([red_and_blue()])  # one that ends


@pytest.mark.parametrize("location", ["../w.bin", "link.bin", "w.bin"])
def test_weights_outside_of_the_models_folder_are_not_read(tmp_path, files, location):
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "w.bin").write_bytes(np.eye(3, dtype=np.float32).tobytes())
    (folder / "link.bin").symlink_to(tmp_path / "w.bin")
    tensor = b"".join(field(1, d) for d in (3, 3, 1, 1)) + field(2, FLOAT) + field(8, "weights")
    tensor += field(13, field(1, "location") + field(2, location)) + field(14, 1)
    nodes = node("Conv", ["photo", "weights"], "logits", kernel_shape=(1, 1))
    model = model_of(folder / "m.onnx", nodes, outputs=[LOGITS], tensors=field(5, tensor))
    if location == "w.bin":  # beside the model
        (folder / "w.bin").write_bytes((tmp_path / "w.bin").read_bytes())
        assert OnnxSegmenter(model, files[1])([red_and_blue()])
        return
    with pytest.raises(LabelError, match=r"m\.onnx: no model that onnxruntime can load"):
        OnnxSegmenter(model, files[1])


def test_without_onnxruntime(tmp_path, monkeypatch):
    (tmp_path / "c.json").write_text(json.dumps(CLASSES))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'sagesplat\[onnx\]'"):
        OnnxSegmenter(tmp_path / "m.onnx", tmp_path / "c.json")


@pytest.mark.parametrize("name", ["deeplabv3plus_mnv2_ade32", "mosaic_r4_ade32"])
def test_real_networks_on_a_real_photo(name):
    pytest.importorskip("onnxruntime", reason="needs sagesplat[onnx]")
    if not (SHARED / "models" / f"{name}.onnx").exists():
        pytest.skip("needs the real scenes beside the checkout")
    full = load_scene(SHARED / "scenes" / "dinosaur")
    scene = Scene(full.name, full.path, full.views[60:61], full.points)
    folder = full.path / "masks"
    given = Masks(folder, Taxonomy.read(folder / "labels.json"))[scene.views[0]]
    segmenter = OnnxSegmenter(SHARED / "models" / f"{name}.onnx", SHARED / "models" / "ade32.json")
    found = segmenter([Photos(scene.views)[0]])[0].label_ids
    for label_id, least in ((184, 0.8), (197, 0.8), (187, 0.9)):
        assert (found[given == label_id] == label_id).mean() > least


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((), FLOAT),
        ((3,), FLOAT),
        ((1, 3, 16), FLOAT),
        ((1, 3, 16, 32, 1), FLOAT),
        ((1, 3, 0, 32), FLOAT),
        ((1, 3, "height", 32), FLOAT),
        ((1, 3, 10**9, 10**9), FLOAT),
        ((1, 3, 2**40, 1), FLOAT),
        ((1, 3, 16, 32), INT64),
        ((1, 3, 16, 32), 8),  # strings
        ((1, 4, 16, 32), FLOAT),
    ],
)
def test_inputs_that_are_no_photo(tmp_path, files, shape, kind):
    nodes = node("Identity", ["photo"], "logits")
    model = model_of(tmp_path / "m.onnx", nodes, [("photo", shape, kind)], [("logits", shape, kind)])
    with pytest.raises(LabelError, match=r"m\.onnx: .*export it") as caught:
        OnnxSegmenter(model, files[1])
    assert len(str(caught.value)) < 1000
