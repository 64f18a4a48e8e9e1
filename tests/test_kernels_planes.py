"""Images in planes: the same memory where that is possible, zeros beyond the width where it is not."""

import pytest
import torch

from sagesplat.kernels.planes import from_bytes, padded, to_image, to_planes
from sagesplat.kernels.workspace import Workspace


@pytest.mark.parametrize("width", [16, 37, 48])
@pytest.mark.parametrize("contiguous", [True, False])
def test_there_and_back(width, contiguous):
    image = torch.rand(5, width, 3)
    given = image if contiguous else image.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    space = Workspace()
    space.take("image", 3, 5, padded(width)).fill(7)
    planes = to_planes(given, space, "image")
    assert planes.shape == (3, 5, padded(width))
    assert (planes[..., width:] == 0).all()
    assert torch.equal(to_image(planes, width), image)


def test_whole_planes_are_not_copied():
    planes = torch.rand(3, 4, 32).numpy()
    again = to_planes(to_image(planes, 32), Workspace(), "image")
    assert again.ctypes.data == planes.ctypes.data


@pytest.mark.parametrize("width", [32, 33])
def test_photos_are_what_torch_makes_of_them(width):
    photo = torch.randint(0, 256, (7, width, 3), dtype=torch.uint8)
    assert torch.equal(from_bytes(photo), photo.float() / 255)
