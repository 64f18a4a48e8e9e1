"""Label images and the taxonomy that names their ids."""

from dataclasses import dataclass
from pathlib import Path

UNLABELLED = -1  # pixels, points and Gaussians without a category
UNLABELLED_NAME = "unlabelled"
