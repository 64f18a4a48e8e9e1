"""FLIP: how visible a difference is when two pictures alternate (Andersson et al. 2020)."""

from importlib.util import find_spec

import numpy as np
from jaxtyping import Float32

from sagesplat.core.errors import BackendUnavailable
from sagesplat.core.extras import install

PIXELS_PER_DEGREE = 67.0  # of visual angle: FLIP's own, a monitor 3840 px and 0.7 m wide seen from 0.7 m


def missing() -> str | None:
    """Why there is no FLIP, and its cure, in one line; None where there is."""
    if find_spec("flip_evaluator") is not None:
        return None
    return f"flip-evaluator is not installed; {install('sagesplat[flip]')}"


def flip_map(
    image: Float32[np.ndarray, "H W 3"],
    reference: Float32[np.ndarray, "H W 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float32[np.ndarray, "H W"]:
    """LDR-FLIP at every pixel: 0 = no difference to be seen, 1 = the largest.

    Args:
        image: sRGB in [0, 1].
        reference: What it is compared with, likewise.
        pixels_per_degree: Of visual angle, at which the pictures are looked at.

    Raises:
        BackendUnavailable: Without the extra `flip`.

    Example:
        >>> import numpy as np
        >>> from sagesplat.metrics.flip import flip_map
        >>> photo = np.random.default_rng(0).random((32, 48, 3), np.float32)
        >>> float(flip_map(photo, photo).max())  # doctest: +SKIP
        0.0
    """
    if (why := missing()) is not None:
        raise BackendUnavailable(f"no FLIP: {why}")
    import flip_evaluator

    how = {"ppd": float(pixels_per_degree)}
    errors, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference), np.ascontiguousarray(image), "LDR",
        applyMagma=False, computeMeanError=False, parameters=how,
    )  # fmt: skip
    return np.asarray(errors, np.float32)[..., 0]
