"""Networks of Hugging Face: their folder or download, what they are, their weights, the device they run on.

Weights are safetensors and no code of theirs runs. Whatever transformers says becomes one line.
"""

import re
import textwrap
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import Image
from torch import Tensor

from sagesplat.core.errors import BackendUnavailable, LabelError, OutOfMemory, SageError, short
from sagesplat.core.extras import install
from sagesplat.core.memory import ran_out
from sagesplat.segment.segmenters import parse_device

_FILES = ["*.json", "*.txt", "model*.safetensors"]  # of a repository: never pickles, never code
_VOCABULARIES = "tokenizer.json", "vocab.json", "vocab.txt"
WHOLE = "config.json, preprocessor_config.json and model.safetensors that belong together"


def torch_device(device: str) -> torch.device:
    """The device of a name; `auto` is a GPU where there is one. Raises BackendUnavailable."""
    kind, index = parse_device(device)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if kind == "cpu" or (kind == "auto" and not count):
        return torch.device("cpu")
    if index >= count:
        raise BackendUnavailable(f"device {device}: this machine has {count} CUDA devices; use --device cpu")
    return torch.device("cuda", index)


def model_setting(model: str) -> Path | str:
    """What answers depend on of a network: its folder, whose content counts, or its name."""
    return Path(model) if Path(model).is_dir() else model


def folder_of(model: str | Path) -> Path:
    """The folder of a network: the one given, or that of the cache after a download where needed."""
    name = str(model)
    if name and Path(name).is_dir():
        return Path(name)
    if isinstance(model, Path) or re.fullmatch(r"[\w-][\w.-]*(/[\w-][\w.-]*)?", name) is None:
        raise LabelError(f"{name}: no such folder; name one with config.json, or a network as owner/name")
    huggingface_hub = package("huggingface_hub")
    try:
        return Path(huggingface_hub.snapshot_download(name, allow_patterns=_FILES))
    except Exception as error:  # of the hub's client, of its HTTP library or of the disk
        raise BackendUnavailable(
            f"{name}: no folder, not in Hugging Face's cache, and no download ({first_line(error)}); "
            f"where there is a network: hf download {name}, then set HF_HUB_OFFLINE=1"
        ) from None


def read_config(folder: Path, name: str, families: Collection[str], purpose: str) -> Any:
    """The configuration of a network of one of these families; LabelError for another.

    `name`: as the user named the network; `purpose`: what it is for, in words.
    """
    transformers = package("transformers")
    try:
        config = transformers.AutoConfig.from_pretrained(folder, trust_remote_code=False)
    except Exception as error:  # many kinds for what may be in the file
        if ran_out(error):
            raise
        raise LabelError(
            f"{name}: no network of transformers ({first_line(error)}); name one for {purpose}"
        ) from None
    if config.model_type not in families:
        kind = short(config.model_type)
        raise LabelError(f"{name}: a network of kind {kind}; take one of {', '.join(sorted(families))}")
    return config


@contextmanager
def loading(name: str, needs: str = WHOLE) -> Iterator[None]:
    """What loads the parts of a network: each failure becomes one line with the network's name."""
    try:
        yield
    except SageError:
        raise
    except ImportError as error:
        raise BackendUnavailable(f"{name}: needs another package ({first_line(error)}); install it") from None
    except Exception as error:  # of many kinds for files that are missing, damaged or do not fit
        if ran_out(error):
            raise
        raise LabelError(f"{name}: cannot be loaded ({first_line(error)}); it needs {needs}") from None


def load_model(kind: Any, folder: Path, name: str, config: Any = None) -> Any:
    """The network of a folder, in 32 bits, of a model class of transformers; LabelError without weights."""
    model, info = kind.from_pretrained(
        folder, config=config, use_safetensors=True, dtype=torch.float32, output_loading_info=True
    )
    absent = sorted(set(info["missing_keys"]) & {key for key, _ in model.named_parameters()})
    if absent:
        raise LabelError(
            f"{name}: weights lack {len(absent)} parameters ({absent[0]}, ...); take a trained network"
        )
    return model


def load_image_processor(folder: Path, **more: Any) -> Any:
    """The image processor of a folder, which computes with PIL."""
    processors = package("transformers").AutoImageProcessor
    return processors.from_pretrained(folder, backend="pil", trust_remote_code=False, **more)


def load_tokenizer(folder: Path) -> Any:
    """The tokenizer of a folder; without its files transformers makes one that knows no words."""
    if not any((folder / name).is_file() for name in _VOCABULARIES):
        raise OSError(f"no {', '.join(_VOCABULARIES)}")
    return package("transformers").AutoTokenizer.from_pretrained(folder, trust_remote_code=False)


def prepared(processor: Any, photos: Sequence[UInt8[np.ndarray, "H W 3"]], name: str) -> Any:
    """Photos as a network's input, by its own image processor; LabelError where that cannot take them.

    They are passed as PIL images: arrays 3 pixels high are ambiguous.
    """
    try:
        return processor(images=[Image.fromarray(photo) for photo in photos], return_tensors="pt")
    except (ValueError, ZeroDivisionError) as error:
        height, width = photos[0].shape[:2]
        raise LabelError(
            f"{name}: cannot take a photo of {width} x {height} pixels ({first_line(error)}); "
            "leave such photos out"
        ) from None


def finite(values: Float[Tensor, "*S"], name: str) -> Float32[np.ndarray, "*S"]:
    """A network's output as numpy; LabelError where it holds what is no number."""
    found = values.float().cpu().numpy()
    if not np.isfinite(found).all():
        raise LabelError(f"{name}: scores that are not finite; try --device cpu or another network")
    return found


def package(name: str) -> Any:
    """A package that segmentation by networks of Hugging Face needs; BackendUnavailable without it."""
    try:
        return __import__(name)
    except ImportError:
        raise BackendUnavailable(
            f"segmentation by a network of Hugging Face needs transformers; {install('sagesplat[hf]')}"
        ) from None


@contextmanager
def quiet() -> Iterator[None]:
    """No log lines and progress bars of transformers: what matters becomes an error."""
    logging = package("transformers").utils.logging
    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()


@contextmanager
def computing(name: str, device: torch.device, photos: int) -> Iterator[None]:
    """What computes with a network: where memory runs out, one line says so."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:  # of a GPU's too
        if not (isinstance(error, torch.cuda.OutOfMemoryError) or ran_out(error)):
            raise
        raise OutOfMemory(
            f"{name}: no memory on {device} for {photos} photos at once; "
            f"take fewer, smaller photos{'' if device.type == 'cpu' else ' or --device cpu'}"
        ) from None


def first_line(error: Exception) -> str:
    """What an error says, without the lists and advice that transformers adds."""
    return textwrap.shorten(str(error).strip().partition("\n")[0], 200, placeholder=" ...")
