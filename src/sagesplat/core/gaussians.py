"""The Gaussians type: a labelled splat scene as plain tensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sagesplat.core.errors import DataError

BYTES_PER_GAUSSIAN = 248  # 62 float32, as in INRIA's PLY: the model size that the paper counts

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
# of the same tensors: what gsplat's trainers call them, and nerfstudio's where those differ
_GSPLAT = dict(zip(PARAMETERS, ("means", "quats", "scales", "opacities", "sh0", "shN"), strict=True))
_NERFSTUDIO = {"sh0": "features_dc", "shN": "features_rest"}


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N labelled 3D Gaussians: float32 tensors on one device, named as in gsplat.

    `log_scales` and `logit_opacities` hold what is optimised: the logarithm of the standard deviations, and
    the opacity before the sigmoid. `label_ids` are category ids, -1: unlabelled. Clones and splits inherit
    them.
    """

    means: Float[Tensor, "N 3"]  # world
    quats: Float[Tensor, "N 4"]  # wxyz, any length but zero
    log_scales: Float[Tensor, "N 3"]  # natural log of the standard deviations, world units
    logit_opacities: Float[Tensor, " N"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N K 3"]  # K = 0, 3, 8 or 15: degree 0 to 3
    label_ids: Int[Tensor, " N"]  # int16

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in shN."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.shN.shape[1]]

    @property
    def nbytes(self) -> int:
        """Model size as the paper counts it: 248 bytes per Gaussian."""
        return len(self) * BYTES_PER_GAUSSIAN

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors by name."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def select(self, index: Tensor) -> "Gaussians":
        """The Gaussians that a boolean mask or an index tensor selects."""
        return Gaussians(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def slices(self, parts: Sequence[slice]) -> "Gaussians":
        """The Gaussians of some slices, in order: a copy."""
        whole = [slice(0, 0), *parts]
        return Gaussians(
            **{f.name: torch.cat([getattr(self, f.name)[p] for p in whole]) for f in fields(self)}
        )

    def of_labels(self, label_ids: Sequence[int]) -> "Gaussians":
        """The Gaussians of these categories."""
        wanted = torch.tensor(list(label_ids), dtype=self.label_ids.dtype, device=self.label_ids.device)
        return self.select(torch.isin(self.label_ids, wanted))

    def counts(self) -> dict[int, int]:
        """Number of Gaussians by label id."""
        ids, counts = torch.unique(self.label_ids, return_counts=True)
        return dict(zip(ids.tolist(), counts.tolist(), strict=True))

    def to(self, device: torch.device | str) -> "Gaussians":
        """The same Gaussians on a device; tensors already there are shared."""
        return Gaussians(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    @classmethod
    def from_gsplat(
        cls, splats: Mapping[str, Tensor], label_ids: Int[Tensor, " N"] | None = None
    ) -> "Gaussians":
        """The Gaussians of a training with gsplat or nerfstudio, as they are before any activation.

        Args:
            splats: What gsplat's trainers call `splats` (a `ParameterDict` or a checkpoint's dictionary):
                "means" [N, 3], "scales" [N, 3] (natural log), "quats" [N, 4] (wxyz, any length but zero),
                "opacities" [N] (logit), "sh0" [N, 1, 3], "shN" [N, K, 3] with K = 0, 3, 8 or 15. Or the
                `gauss_params` of nerfstudio's splatfacto: "features_dc" [N, 3] and "features_rest" in place
                of the last two, "opacities" [N, 1]; with sh_degree 0 its colours are no harmonics. Keys may
                have a prefix that ends in a dot, as in a checkpoint; others are left alone.
            label_ids: Category ids, -1: unlabelled (default: all are unlabelled).

        Returns:
            float32 tensors on the device of "means", detached; shared where they are float32 already.

        Raises:
            DataError: For missing tensors and other shapes, such as the two scales of 2DGS.

        Example:
            >>> import torch
            >>> from sagesplat import Gaussians
            >>> z = torch.zeros
            >>> splats = {"means": z(5, 3), "scales": z(5, 3), "quats": z(5, 4) + 1, "opacities": z(5)}
            >>> g = Gaussians.from_gsplat({**splats, "sh0": z(5, 1, 3), "shN": z(5, 15, 3)})
            >>> len(g), g.sh_degree, sorted(g.to_gsplat())
            (5, 3, ['means', 'opacities', 'quats', 'scales', 'sh0', 'shN'])
        """
        given = {str(key).rpartition(".")[2]: value for key, value in splats.items()}
        names = _GSPLAT | (_NERFSTUDIO if "features_dc" in given else {})
        if missing := [name for name in names.values() if not isinstance(given.get(name), Tensor)]:
            raise DataError(
                f"splats: no tensors {', '.join(missing)}; give gsplat's means, scales, quats, opacities, "
                "sh0 and shN, or nerfstudio's gauss_params"
            )
        tensors = {own: given[name].detach() for own, name in names.items()}
        device, count = tensors["means"].device, tensors["means"].shape[0] if tensors["means"].ndim else 0
        if tensors["logit_opacities"].shape == (count, 1):
            tensors["logit_opacities"] = tensors["logit_opacities"][:, 0]
        if tensors["sh0"].shape == (count, 3):
            tensors["sh0"] = tensors["sh0"][:, None]
        labels = torch.full((count,), -1) if label_ids is None else label_ids
        tensors = {name: tensor.to(device, torch.float32) for name, tensor in tensors.items()}
        tensors["label_ids"] = labels.to(device, torch.int16)
        if misfit := _misfit(tensors):
            shape = list(tensors[misfit].shape)
            name = names.get(misfit, misfit)
            raise DataError(f"splats: {name} is of shape {shape}; give N Gaussians as 3DGS has them")
        return cls(**tensors)

    def to_gsplat(self) -> dict[str, Tensor]:
        """The tensors by the names of gsplat's trainers, as `from_gsplat` takes them; shared, no copies.

        `torch.nn.ParameterDict(g.to_gsplat())` is what a training with gsplat goes on from.
        """
        return {name: getattr(self, own) for own, name in _GSPLAT.items()}

    def detach(self) -> "Gaussians":
        """The same Gaussians, detached from the autograd graph."""
        return replace(self, **{name: p.detach() for name, p in self.parameters().items()})


def checked(g: Gaussians) -> Gaussians:
    """`g` itself; ValueError unless its tensors have the shapes and types above."""
    if misfit := _misfit({f.name: getattr(g, f.name) for f in fields(g)}):
        raise ValueError(f"{misfit} is of shape {list(getattr(g, misfit).shape)}")
    if any(p.dtype != torch.float32 for p in g.parameters().values()) or g.label_ids.dtype != torch.int16:
        raise ValueError("parameters are not float32, or label_ids not int16")
    return g


def _misfit(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of a tensor that does not have the shape that the others ask for; None: all fit."""
    opacities, shN = tensors["logit_opacities"], tensors["shN"]
    n, k = opacities.shape[0] if opacities.ndim else -1, shN.shape[1] if shN.ndim == 3 else -1
    shapes = {"logit_opacities": (n,), "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3)}
    shapes |= {"sh0": (n, 1, 3), "shN": (n, k if k in (0, 3, 8, 15) else -1, 3), "label_ids": (n,)}
    return next((name for name, shape in shapes.items() if tensors[name].shape != shape), None)


def relabelled(g: Gaussians, label_of: Mapping[int, int]) -> Gaussians:
    """The same Gaussians with other label ids, by those that they have."""
    before = torch.tensor(sorted(label_of), device=g.label_ids.device, dtype=g.label_ids.dtype)
    after = torch.tensor([label_of[i] for i in sorted(label_of)], device=before.device, dtype=before.dtype)
    return replace(g, label_ids=after[torch.searchsorted(before, g.label_ids)])


def gather(parts: Sequence[tuple[Gaussians, Tensor]]) -> Gaussians:
    """The Gaussians at some rows (int64) of several sets, in order, as `concat` has them; no other copy is
    made on the way.
    """
    sizes = [len(rows) for _, rows in parts]
    bases, found = max(g.shN.shape[1] for g, _ in parts), dict[str, Tensor]()
    for name in (f.name for f in fields(Gaussians)):
        values = [getattr(g, name) for g, _ in parts]
        shape = (bases, 3) if name == "shN" else values[0].shape[1:]
        found[name] = values[0].new_zeros((sum(sizes), *shape))
        for all_of_it, (_, rows), out in zip(values, parts, found[name].split(sizes), strict=True):
            if out.shape[1:] == all_of_it.shape[1:]:
                torch.index_select(all_of_it, 0, rows, out=out)
            else:
                out[:, : all_of_it.shape[1]] = all_of_it[rows]
    return Gaussians(**found)


def concat(parts: Sequence[Gaussians]) -> Gaussians:
    """The Gaussians of several sets, in order; shN is zero-padded to the largest degree."""
    bases = max(p.shN.shape[1] for p in parts)
    padded = [
        replace(p, shN=torch.nn.functional.pad(p.shN, (0, 0, 0, bases - p.shN.shape[1])))
        if p.shN.shape[1] < bases  # padding by nothing copies
        else p
        for p in parts
    ]
    return Gaussians(**{f.name: torch.cat([getattr(p, f.name) for p in padded]) for f in fields(Gaussians)})
