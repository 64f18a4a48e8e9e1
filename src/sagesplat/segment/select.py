"""Gaussians by the names of categories and instances."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from sagesplat.core.errors import LabelError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import composed
from sagesplat.segment.edit import alternatives
from sagesplat.segment.parents import with_instances


def select_mask(
    gaussians: Gaussians, wanted: str, names: Mapping[int, str], parents: Mapping[int, str] | None = None
) -> Bool[Tensor, " N"]:
    """Which Gaussians are of some categories or instances.

    Args:
        gaussians: N labelled Gaussians.
        wanted: A name, or several as in "chair 2,vase". A category means its instances too.
        names: Names by label id: `FinishedRun.names`, or `Splat.names` of `read_splat`.
        parents: By label id of an instance, its category: `FinishedRun.parents` or `Splat.parents`.

    Returns:
        Bool [N], on the device of the Gaussians.

    Raises:
        LabelError: For a name that there is not.
    """
    of = {names[label]: parent for label, parent in (parents or {}).items() if label in names}
    found = list[int]()
    for name in (part.strip() for part in wanted.split(",")):
        ids = with_instances(names, of, composed(name))
        if not ids:
            known = alternatives(name, names.values())
            raise LabelError(f"no category or instance {short(repr(name))}; {known}")
        found += ids
    ids = torch.tensor(found, dtype=gaussians.label_ids.dtype, device=gaussians.label_ids.device)
    return torch.isin(gaussians.label_ids, ids)


def select(
    gaussians: Gaussians, wanted: str, names: Mapping[int, str], parents: Mapping[int, str] | None = None
) -> Gaussians:
    """The Gaussians of some categories or instances. Arguments and errors are those of `select_mask`.

    Example:
        >>> import torch
        >>> from sagesplat import Gaussians, select
        >>> z = torch.zeros
        >>> ids = torch.tensor([62, 201, 202, 202], dtype=torch.int16)
        >>> g = Gaussians(z(4, 3), z(4, 4) + 1, z(4, 3), z(4), z(4, 1, 3), z(4, 0, 3), ids)
        >>> names, parents = {62: "chair", 201: "chair 1", 202: "chair 2"}, {201: "chair", 202: "chair"}
        >>> len(select(g, "chair 2", names, parents)), len(select(g, "chair", names, parents))
        (2, 4)
    """
    return gaussians.select(select_mask(gaussians, wanted, names, parents))
