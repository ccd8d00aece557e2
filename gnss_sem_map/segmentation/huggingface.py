"""Networks of the transformers library as segmenters: those that give logits, and those that give masks.

The output of a mask network is a set of queries, each with class probabilities and a mask. Its post-processing gives
only the best class of every pixel; we need the probabilities of all (Cheng et al., "MaskFormer", NeurIPS 2021, section
3.4).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate
from transformers import (
    MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING,
    AutoConfig,
    AutoImageProcessor,
    AutoModelForSemanticSegmentation,
    AutoModelForUniversalSegmentation,
    AutoTokenizer,
)
from transformers.models.auto.image_processing_auto import (
    IMAGE_PROCESSOR_MAPPING_NAMES,
    get_image_processor_class_from_name,
)
from transformers.utils import cached_file, logging

from gnss_sem_map.errors import DataError, errors_of_others, program
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.segmentation.classes import VOID, named_classes
from gnss_sem_map.segmentation.networks import (
    NetworkSegmenter,
    Prepare,
    Probabilities,
    find_device,
    from_logits,
)
from gnss_sem_map.segmentation.pixels import STRIDE, scale_and_shrink, whole_strides

MASK_NETWORKS = ("maskformer", "mask2former", "oneformer", "eomt", "eomt_dinov3")
"""Mask networks; all others of the library for semantic segmentation give logits."""

SQUARE_NETWORKS = ("eomt", "eomt_dinov3", "dpt", "beit", "data2vec-vision")
"""They see squares of the size that their config says, and no other shape."""

PROCESSOR_FILES = ("preprocessor_config.json", "processor_config.json")

AS_IT_IS = {
    "do_resize": False, "do_center_crop": False, "do_pad": False, "do_split_image": False, "class_info_file": None,
}  # fmt: skip
"""What an image processor is told: the map needs every pixel, undistorted, and nothing is fetched."""

LOCAL = {"local_files_only": True, "_raise_exceptions_for_missing_entries": False}

TASK = "the task is semantic"
"""Task prompt of OneFormer."""


def open_huggingface(
    model: str, label_set: LabelSet, device: str = "auto", classes: str | None = None,
    scale: str | None = None, shrink: str | None = None,
) -> NetworkSegmenter:  # fmt: skip
    """A network of transformers from a folder, or from the local cache of `hf download MODEL`.

    Pixels are prepared by its image processor (without a file of that, by the one of its kind), but for the resizing,
    which would distort wide images. Class names are its own unless `classes` is given. Raises
    DataError for a missing model or one of another kind, ConfigError for class names that the class set does not know.
    """
    where = find_device(device)
    as_scale, as_shrink = scale_and_shrink(scale, shrink, f"hf:{model}")
    config, network = _load(model)
    network.to(where).eval()
    own = [str(config.id2label.get(i, f"LABEL_{i}")) for i in range(config.num_labels)]
    names = named_classes(classes, config.num_labels, label_set, f"hf:{model}", own)
    masks = config.model_type in MASK_NETWORKS
    see = _masks(network, config, names, model, where) if masks else _logits(network, names)
    if config.model_type in SQUARE_NETWORKS:
        see = _in_windows(see, config.image_size)
    run = _stretched(_shares(see) if masks else see)
    kept = [name for name in names if name != VOID]
    return NetworkSegmenter(f"hf:{model}", run, kept, where, preparation(model, config), as_scale, as_shrink)


def _load(model: str) -> tuple[Any, Any]:
    is_folder = Path(model).is_dir()
    is_path = Path(model).exists() or model.startswith((".", "/", "~")) or model.count("/") > 1
    if is_path and not is_folder:
        raise DataError(f"hf:{model}: no such folder; expected one with config.json, or the name of a model")
    with _quiet(), errors_of_others(f"hf:{model}: cannot be read (", ")"):
        try:
            config = AutoConfig.from_pretrained(model, local_files_only=True, trust_remote_code=False)
            network, report = _kind(config, model).from_pretrained(
                model, local_files_only=True, output_loading_info=True
            )
        except OSError:
            if is_folder:
                raise
            raise DataError(f"hf:{model}: not here; run `{program('hf')} download {model}`") from None
    unset = sorted([*report["missing_keys"], *report["mismatched_keys"]])
    if unset:
        raise DataError(f"hf:{model}: the file lacks {len(unset)} tensors of the network: {unset[:3]}")
    return config, network


def _kind(config: Any, model: str) -> Any:
    if config.model_type in MASK_NETWORKS:
        return AutoModelForUniversalSegmentation
    if type(config) in MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING:
        return AutoModelForSemanticSegmentation
    raise DataError(f"hf:{model}: {config.model_type} is no segmentation network, as segformer is")


@contextmanager
def _quiet() -> Iterator[None]:
    """Switch off progress bars and tables of the library; errors are reported by ours."""
    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()


def _logits(network: Any, names: tuple[str, ...]) -> Probabilities:
    return from_logits(lambda images: network(pixel_values=images).logits, names)


def _masks(
    network: Any, config: Any, names: tuple[str, ...], model: str, device: torch.device
) -> Probabilities:
    kept = [i for i, name in enumerate(names) if name != VOID]
    extra: dict[str, Tensor] = {}
    if config.model_type == "oneformer":
        extra["task_inputs"] = _task_tokens(model, config).to(device)

    def masses(images: Tensor, size: tuple[int, int]) -> Tensor:
        task = {name: value.expand(len(images), -1) for name, value in extra.items()}
        answer = network(pixel_values=images, **task)
        masks = interpolate(
            answer.masks_queries_logits, size=size, mode="bilinear", align_corners=False
        ).sigmoid()
        classes = answer.class_queries_logits.softmax(2)[:, :, kept]  # not the last one, which is "no object"
        return torch.einsum("bqc, bqhw -> bchw", classes, masks)

    return masses


def _shares(masses: Probabilities) -> Probabilities:
    """Of the masses of all classes, each one's share."""

    def probabilities(images: Tensor, size: tuple[int, int]) -> Tensor:
        mass = masses(images, size)
        return mass / mass.sum(1, keepdim=True).clamp_min(1e-6)

    return probabilities


def _in_windows(see: Probabilities, image_size: int | list[int]) -> Probabilities:
    """For a network of a fixed, square input: the shorter side is scaled to it, the longer is processed in windows."""
    side = image_size if isinstance(image_size, int) else image_size[0]

    def windowed(images: Tensor, size: tuple[int, int]) -> Tensor:
        height, width = images.shape[2:]
        ratio = side / min(height, width)
        whole = interpolate(images, size=(max(side, round(height * ratio)), max(side, round(width * ratio))),
                            mode="bilinear", align_corners=False)  # fmt: skip
        corners = [
            (top, left) for top in _starts(whole.shape[2], side) for left in _starts(whole.shape[3], side)
        ]
        parts = [
            see(whole[:, :, top : top + side, left : left + side], (side, side)) for top, left in corners
        ]
        total = parts[0].new_zeros(*parts[0].shape[:2], *whole.shape[2:])
        count = parts[0].new_zeros(whole.shape[2:])
        for (top, left), part in zip(corners, parts, strict=True):
            total[:, :, top : top + side, left : left + side] += part
            count[top : top + side, left : left + side] += 1
        return interpolate(total / count, size=size, mode="bilinear", align_corners=False)

    return windowed


def _starts(length: int, side: int) -> list[int]:
    """Where windows of `side` begin that cover `length`, evenly spread."""
    windows = -(-length // side)
    return [0] if windows == 1 else [round(i * (length - side) / (windows - 1)) for i in range(windows)]


def _stretched(probabilities: Probabilities) -> Probabilities:
    def run(images: Tensor, size: tuple[int, int]) -> Tensor:
        whole = [whole_strides(side) for side in images.shape[2:]]
        return probabilities(interpolate(images, size=whole, mode="bilinear", align_corners=False), size)

    return run


def _task_tokens(model: str, config: Any) -> Tensor:
    tokenizer: Callable[..., Any] = AutoTokenizer.from_pretrained(model, local_files_only=True)
    tokens = tokenizer(
        [TASK], padding="max_length", max_length=config.task_seq_len, truncation=True, return_tensors="pt"
    )
    masked: Tensor = tokens["input_ids"] * tokens["attention_mask"]
    # without its vocabulary a tokenizer gives every word the same token
    if len(masked.unique()) < len(TASK.split()):
        raise DataError(f"hf:{model}: its tokenizer does not know {TASK!r}; vocab.json, merges.txt?")
    return masked


def preparation(model: str, config: Any) -> Prepare:
    """The image processor of the model, but for its resizing: it knows the order of channels, their range and mean.

    Raises DataError where its file makes none.
    """
    broken = f"hf:{model}: its image processor, as preprocessor_config.json sets it, cannot be used: "
    with _quiet(), errors_of_others(broken):
        if any(cached_file(model, name, **LOCAL) for name in PROCESSOR_FILES):
            processor = AutoImageProcessor.from_pretrained(
                model, local_files_only=True, backend="pil", trust_remote_code=False, **AS_IT_IS
            )
        else:
            kind = IMAGE_PROCESSOR_MAPPING_NAMES[config.model_type]["pil"]
            processor = get_image_processor_class_from_name(kind)(**AS_IT_IS)
        processor(np.zeros((STRIDE, STRIDE, 3), np.uint8), return_tensors="pt")

    def prepare(pixels: NDArray[np.uint8]) -> Tensor:
        seen = processor(list(pixels), return_tensors="pt", input_data_format="channels_last")
        return torch.as_tensor(seen["pixel_values"], dtype=torch.float32)

    return prepare
