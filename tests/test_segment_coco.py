import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_segment_masks import scene_of

from sagesplat.core.errors import LabelError
from sagesplat.segment import coco
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy

EXAMPLES = Path(__file__).resolve().parents[2] / "shared" / "models" / "coco_panoptic"


def write_segments(path, segment_ids):
    ids = np.array(segment_ids)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.stack([ids % 256, ids // 256 % 256, ids // 65536], -1).astype(np.uint8)).save(path)


def write_json(path, name="a.png", segments=((70000, 184), (300, 193)), **more):
    info = [{"id": s, "category_id": c} for s, c in segments]
    path.write_text(json.dumps({"annotations": [{"file_name": name, "segments_info": info}], **more}))


@pytest.mark.parametrize("beside", ["", "panoptic/"])
def test_segments_become_categories(tmp_path, beside):
    source, target = tmp_path / "source", tmp_path / "target"
    write_segments(source / f"{beside}a.png", [[70000, 300], [0, 300]])
    write_json(source / "panoptic.json")
    (source / "panoptic_coco_categories.json").write_text("[]")  # a JSON without annotations is no obstacle
    scene = scene_of("a.jpg", "b.jpg", width=2, height=2)
    assert import_masks(scene, source, target) == ["b.jpg"]
    taxonomy = Taxonomy.read(target / "labels.json")
    assert taxonomy.names == {184: "tree-merged", 193: "grass-merged"}
    masks = Masks(target, taxonomy)
    np.testing.assert_array_equal(masks[scene.views[0]], [[184, 193], [-1, 193]])
    assert (masks[scene.views[1]] == -1).all()


def test_the_json_may_bring_its_own_names(tmp_path):
    write_segments(tmp_path / "in" / "a.png", [[7]])
    write_json(tmp_path / "in" / "x.json", segments=[(7, 500)], categories=[{"id": 500, "name": "statue"}])
    import_masks(scene_of("a.jpg", width=1, height=1), tmp_path / "in", tmp_path / "out")
    assert Taxonomy.read(tmp_path / "out" / "labels.json").names == {500: "statue"}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ('{"annotations": 3}', "not in COCO's panoptic format"),
        (
            '{"annotations": [{"file_name": "a.png", "segments_info": [{"id": 7, "category_id": 999}]}]}',
            "999",
        ),
        (
            '{"annotations": [{"file_name": "a.png", "segments_info": [{"id": -7, "category_id": 1}]}]}',
            "expected int >= 0",
        ),
        (
            '{"annotations": [{"file_name": "a.png", "segments_info": [{"id": 8, "category_id": 1}]}]}',
            "ids 7;",
        ),
    ],
)
def test_bad_json(tmp_path, content, complaint):
    write_segments(tmp_path / "in" / "a.png", [[7]])
    (tmp_path / "in" / "x.json").write_text(content)
    with pytest.raises(LabelError, match=complaint):
        import_masks(scene_of("a.jpg", width=1, height=1), tmp_path / "in", tmp_path / "out")


def test_several_jsons_and_grey_pngs(tmp_path):
    write_json(tmp_path / "x.json")
    Image.fromarray(np.zeros((1, 1), np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(LabelError, match="mode L where an RGB image of segments"):
        import_masks(scene_of("a.jpg", width=1, height=1), tmp_path, tmp_path / "out")
    write_json(tmp_path / "y.json")
    with pytest.raises(LabelError, match=r"several JSON files with annotations \(x.json, y.json\)"):
        import_masks(scene_of("a.jpg", width=1, height=1), tmp_path, tmp_path / "out")


def test_cocos_own_annotations(tmp_path):
    """Against the areas that COCO itself states for every segment."""
    if not EXAMPLES.exists():
        pytest.skip("needs the real scenes beside the checkout")
    shutil.copy(EXAMPLES / "panoptic_examples.json", tmp_path)
    content = json.loads((EXAMPLES / "panoptic_examples.json").read_text())
    for image, annotation in zip(content["images"], content["annotations"], strict=True):
        name = annotation["file_name"]
        shutil.copy(EXAMPLES / name.replace(".png", "_panoptic.png"), tmp_path / name)
        scene = scene_of(image["file_name"], width=image["width"], height=image["height"])
        import_masks(scene, tmp_path, tmp_path / "out")
        taxonomy = Taxonomy.read(tmp_path / "out" / "labels.json")
        areas = dict.fromkeys(taxonomy.names, 0)
        for segment in annotation["segments_info"]:
            areas[segment["category_id"]] += segment["area"]
        ids, counts = np.unique(Masks(tmp_path / "out", taxonomy)[scene.views[0]], return_counts=True)
        counted = dict(zip(ids.tolist(), counts.tolist(), strict=True))
        counted.pop(-1, None)
        assert counted == areas
        assert all(coco.NAMES[i] == name for i, name in taxonomy.names.items())


def test_the_table_is_cocos():
    assert len(coco.NAMES) == len(set(coco.NAMES.values())) == 133
    assert (coco.NAMES[1], coco.NAMES[200]) == ("person", "rug-merged")
    assert coco.COLORS[1] == (220, 20, 60)
    assert coco.COLORS[200] == (250, 141, 255)
