"""Outlier masks, learned from the residual: what one photo shows and the others do not."""

import os
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

R=int(os.environ.get("OR","4")); K=float(os.environ.get("OK","6")); LEAST=float(os.environ.get("OL","0.05")); START=float(os.environ.get("OS","0.15")); GROW=int(os.environ.get("OG","4"))


@dataclass(frozen=True)
class Outliers:
    max_steps: int

    def __call__(self, rgb, photo, valid, step):
        if step < START * self.max_steps:
            return valid
        photo = photo if photo.is_floating_point() else photo.float() / 255
        diff = (photo - rgb).permute(2, 0, 1)[None]
        if valid is not None:
            diff = diff * valid
        side = 2 * R + 1
        mag = F.avg_pool2d(diff, side, 1, R, count_include_pad=False).abs().mean(1, keepdim=True)
        threshold = max(K * float(mag.median()), LEAST)
        out = (mag > threshold).float()
        out = F.max_pool2d(out, 2 * GROW + 1, 1, GROW)[0, 0] > 0
        return ~out if valid is None else valid & ~out
