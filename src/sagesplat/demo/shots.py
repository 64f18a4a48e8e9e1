"""One photo of the garden, as it is and as it was taken."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from sagesplat.demo.figures import PERSON, figures_at
from sagesplat.demo.render import render_light, take_photo
from sagesplat.demo.wild import Wild, lens_falloff
from sagesplat.scene.scene import Camera


class Shot(NamedTuple):
    """A photo with its truth; without disturbances both are the same arrays."""

    photo: UInt8[np.ndarray, "H W 3"]
    label: UInt8[np.ndarray, "H W"]  # with the figures, where label images show them
    hidden: Bool[np.ndarray, "H W"]  # where a figure stands
    true_photo: UInt8[np.ndarray, "H W 3"]
    true_label: UInt8[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]  # of the scene without figures


def take_shot(
    camera: Camera,
    number: int,
    seed: int,
    places: tuple[int, int],
    wild: Wild,
    gains: Float64[np.ndarray, "3"],
) -> Shot:
    """The photo of this number on the path; `gains` are its factors of linear RGB.

    Light is disturbed before the tone curve, as in a camera, and the sensor's noise is that of the
    undisturbed photo.
    """
    light, true_label, depth = render_light(camera, seed, places)
    true_photo, true_label = take_photo(light, camera, seed), true_label.astype(np.uint8)
    label = true_label
    hidden = np.zeros(label.shape, bool)
    if wild.quiet:
        return Shot(true_photo, label, hidden, true_photo, true_label, depth)
    if wild.figures:
        figures = figures_at(number, camera.position, wild.figures, seed)
        light, with_figures, _ = render_light(camera, seed, places, figures)
        hidden = with_figures == PERSON
        label = with_figures.astype(np.uint8) if wild.figure_masks else true_label
    photo = take_photo(light * gains * lens_falloff(wild, camera), camera, seed)
    return Shot(photo, label, hidden, true_photo, true_label, depth)
