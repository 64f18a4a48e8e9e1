"""COLMAP's model as text, which the package itself writes as binary files alone."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def write_text_model(folder: Path, cameras, images, xyz, rgb, error) -> None:
    """What `write_model` writes, as text."""

    def text(values) -> str:
        return " ".join(repr(float(v)) for v in values)

    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{c.id} {c.model} {c.width} {c.height} {text(c.params)}" for c in cameras]
    (folder / "cameras.txt").write_text(
        "\n".join(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *lines, ""])
    )
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    tracks: list[list[int]] = [[] for _ in xyz]
    for i in images:
        quat = Rotation.from_matrix(i.w2c[:3, :3]).as_quat(canonical=True, scalar_first=True)
        lines.append(f"{i.id} {text(quat)} {text(i.w2c[:3, 3])} {i.camera_id} {i.name}")
        ids = np.where(i.point_rows >= 0, i.point_rows + 1, -1)
        lines.append(" ".join(f"{text(uv)} {p}" for uv, p in zip(i.uv, ids, strict=True)))
        for index, row in enumerate(i.point_rows):
            tracks[row] += [i.id, index] if row >= 0 else []
    (folder / "images.txt").write_text("\n".join([*lines, ""]))
    points = zip(xyz, rgb, error, tracks, strict=True)
    lines = [
        f"{row} {text(at)} {' '.join(map(str, colour))} {text([e])} {' '.join(map(str, track))}"
        for row, (at, colour, e, track) in enumerate(points, 1)
    ]
    head = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    (folder / "points3D.txt").write_text("\n".join([head, *lines, ""]))
