"""RefineNet weights on disk: only tensors are read, never code, and all of them must fit the network."""

from __future__ import annotations

import json
import pickle
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from gnss_sem_map.errors import DataError, one_line
from gnss_sem_map.files.untrusted import is_file, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.segmentation.backbones import RESNET_BLOCKS
from gnss_sem_map.segmentation.classes import VOID, named_classes
from gnss_sem_map.segmentation.networks import (
    NetworkSegmenter,
    find_device,
    for_inference,
    from_logits,
    normalised,
)
from gnss_sem_map.segmentation.pixels import scale_and_shrink
from gnss_sem_map.segmentation.refinenet import MEAN, STD, LightWeightRefineNet, RefineNet

METADATA = "gnss_sem_map"
"""Key of our JSON in the metadata of a safetensors file."""

LOAD_ERRORS = (
    pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError, AttributeError, IndexError,
    TypeError, OverflowError, ImportError, struct.error, zipfile.BadZipFile,
)  # fmt: skip
"""What torch raises for a file that is damaged, or that holds more than tensors."""

WRAPPERS = ("state_dict", "model", "network", "segmenter")
"""Names under which training programs keep the tensors in a checkpoint."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The tensors of a file, and its metadata."""

    path: Path
    tensors: dict[str, Tensor]
    class_names: tuple[str, ...] | None = None
    scale: float = 1.0
    """Of the images that the network was trained on."""


def open_refinenet(
    path: Path, label_set: LabelSet, device: str = "auto", classes: str | None = None,
    scale: str | None = None, shrink: str | None = None,
) -> NetworkSegmenter:  # fmt: skip
    """RefineNet or Light-Weight RefineNet from a checkpoint; its tensors show which of them it is.

    Class names come from `classes` (see `named_classes`), from the file, or from their number. Raises DataError for a
    file that is not such a checkpoint, ConfigError for class names that do not fit.
    """
    checkpoint = read_checkpoint(path)
    network = network_like(checkpoint)
    load_strictly(network, checkpoint)
    names = named_classes(classes, class_count(checkpoint), label_set, str(path), checkpoint.class_names)
    where = find_device(device)
    network = for_inference(network, where)
    as_scale, as_shrink = scale_and_shrink(scale, shrink, str(path), checkpoint.scale)
    kept = [name for name in names if name != VOID]
    run, prepare = from_logits(network, names), normalised(MEAN, STD, where)
    return NetworkSegmenter(f"refinenet:{path}", run, kept, where, prepare, as_scale, as_shrink)


def read_checkpoint(path: Path) -> Checkpoint:
    """The tensors of a safetensors file, or of a torch file read with `weights_only=True`; raises DataError."""
    if not is_file(path):
        raise DataError(f"checkpoint {shown(path)}: no such file")
    if path.suffix == ".safetensors":
        return _read_safetensors(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except LOAD_ERRORS as error:
        raise DataError(
            f"checkpoint {path}: damaged, or holds code ({type(error).__name__}); save the state_dict alone"
        ) from None
    return Checkpoint(path, _only_tensors(content, path))


def network_like(checkpoint: Checkpoint) -> nn.Module:
    """A new network of the architecture that the names and shapes of the tensors show; raises DataError for another."""
    shapes = {name: tuple(tensor.shape) for name, tensor in checkpoint.tensors.items()}
    count = class_count(checkpoint)
    if "conv1.weight" in shapes and "p_ims1d2_outl1_dimred.weight" in shapes:
        blocks = tuple(sum(name.startswith(f"layer{i}.") and name.endswith("conv1.weight") for name in shapes)
                       for i in (1, 2, 3, 4))  # fmt: skip
        backbone = next((name for name, known in RESNET_BLOCKS.items() if known == blocks), None)
        if backbone is None:
            raise DataError(f"checkpoint {checkpoint.path}: found blocks {blocks}, expected {RESNET_BLOCKS}")
        light_weight = shapes["p_ims1d2_outl1_dimred.weight"][-1] == 1
        return (LightWeightRefineNet if light_weight else RefineNet)(count, backbone)
    if "layer1.0.weight" in shapes and "conv8.weight" in shapes:
        return LightWeightRefineNet(
            count, "mobilenet_v2", width=shapes["conv8.weight"][0],
            depth_head="depth.weight" in shapes, single_task="pre_segm.weight" not in shapes,
        )  # fmt: skip
    raise _other_architecture(checkpoint)


def class_count(checkpoint: Checkpoint) -> int:
    """Number of classes of the last layer; raises DataError if there is no such layer."""
    for name in ("clf_conv.bias", "segm.bias"):
        if name in checkpoint.tensors:
            return checkpoint.tensors[name].numel()
    raise _other_architecture(checkpoint)


def load_strictly(network: nn.Module, checkpoint: Checkpoint) -> None:
    """Load the tensors into the network; raises DataError unless names and shapes agree and all values are finite.

    Only batch counters may be missing: they were not yet saved when the first checkpoints were published.
    """
    expected, found = network.state_dict(), checkpoint.tensors
    missing = sorted(
        name for name in expected.keys() - found.keys() if not name.endswith("num_batches_tracked")
    )
    extra = sorted(found.keys() - expected.keys())
    other = sorted(
        name for name in expected.keys() & found.keys() if expected[name].shape != found[name].shape
    )
    for what, names in (("missing", missing), ("unknown", extra), ("of another shape", other)):
        if names:
            raise DataError(
                f"checkpoint {checkpoint.path}: {len(names)} of {len(expected)} tensors {what}, {names[:3]}"
            )
    damaged = [name for name, tensor in found.items() if not torch.isfinite(tensor).all()]
    if damaged:
        raise DataError(f"checkpoint {checkpoint.path}: {damaged[:3]} are not finite; get it again")
    network.load_state_dict(found, strict=False)


def write_network(
    path: Path, network: nn.Module, class_names: tuple[str, ...], scale: float, half: bool = True
) -> None:
    """Save a network with its class names and image scale as safetensors, in half precision unless told otherwise."""
    tensors = {
        name: (tensor.half() if half and tensor.is_floating_point() else tensor).cpu().contiguous()
        for name, tensor in network.state_dict().items()
    }
    about = {METADATA: json.dumps({"class_names": class_names, "scale": scale})}
    beside = path.with_name(path.name + ".part")
    save_file(tensors, beside, about)
    beside.chmod(0o644)  # temporary files are readable by their owner only
    beside.replace(path)


def _read_safetensors(path: Path) -> Checkpoint:
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {}).get(METADATA, "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        names = about.get("class_names")
        return Checkpoint(
            path, tensors, tuple(map(str, names)) if names else None, float(about.get("scale", 1.0))
        )
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        reason = one_line(error)
        raise DataError(f"checkpoint {shown(path)}: no safetensors file ({reason}); get it again") from None


def _only_tensors(content: Any, path: Path) -> dict[str, Tensor]:
    while isinstance(content, dict) and (
        inner := next((k for k in WRAPPERS if isinstance(content.get(k), dict)), None)
    ):
        content = content[inner]
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(t, Tensor) for t in content.values())
    ):
        raise DataError(f"checkpoint {path}: found {type(content).__name__}, expected a state_dict")
    return {str(name).removeprefix("module."): tensor for name, tensor in content.items()}


def _other_architecture(checkpoint: Checkpoint) -> DataError:
    found = sorted(checkpoint.tensors)[:3]
    return DataError(
        f"checkpoint {checkpoint.path}: found tensors such as {found}, expected those of RefineNet, full or"
        " light-weight, on a ResNet or MobileNet-v2; for other networks use hf:, onnx: or python:"
    )
