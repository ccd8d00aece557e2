"""Segmentation: from images to class probabilities. Defines what a segmenter is, and opens one from its SPEC.

Cheap to import: torch, transformers and onnxruntime are imported by the segmenter that needs them, when it is opened.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError, how_to_install, program
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.sensor_log import Image


class Segmenter(Protocol):
    """Computes class probabilities for every pixel of a camera image."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The source's own names, one per channel; `LabelSet.table_from` maps them to the map's classes."""
        ...

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        """Probabilities (h, w, c): uint8 as round(255 p), or float32 in 0..1; all zero for void pixels.

        (h, w) is the image's size, or that size divided by an integer and rounded down. Raises DataError.
        """
        ...


class MissingLabels(DataError):
    """The segmenter has no labels for this frame; mapping continues without them."""


SCHEMES = {
    "labels": "labels:FOLDER[?ids=train_id|label_id|colour&taxonomy=cityscapes|mapillary|camvid|ade20k]",
    "refinenet": "refinenet:CHECKPOINT[?classes=..&scale=1&shrink=2]",
    "hf": "hf:MODEL_OR_FOLDER[?classes=..&scale=1&shrink=2]",
    "onnx": "onnx:FILE[?classes=..&mean=..&std=..&order=rgb|bgr&pixel_max=1|255&scale=1&shrink=2]",
    "python": "python:package.module:callable[?classes=..]",
    "demo": "demo (for the simulator's images only)",
}
"""Syntax of the SPEC of a segmenter, by the word before the colon."""

OF_NETWORKS = ("classes", "scale", "shrink")
OPTIONS = {
    "labels": ("ids", "taxonomy"), "refinenet": OF_NETWORKS, "hf": OF_NETWORKS,
    "onnx": ("classes", "mean", "std", "order", "pixel_max", "scale", "shrink"), "python": ("classes",),
    "demo": ("shrink",),
}  # fmt: skip
"""What a SPEC may say behind its question mark."""
EXTRAS = {"refinenet": "segmentation", "demo": "segmentation", "hf": "hf", "onnx": "onnx"}
"""What must be installed for it."""

LONGEST_SPEC = 1000

DEMO_NETWORK = Path(__file__).parent / "demo_network" / "network.safetensors"
"""Trained on simulated streets; see its README."""

DEMO_CALIBRATION = DEMO_NETWORK.with_name("calibration.yaml")
"""Confusion model of that network, from two other simulated drives: for `--set calibration=FILE`."""


def no_segmenter_message(drive: str) -> str:
    """Help text for a drive without labels: three networks for real streets, how to get them, their licences."""
    lines = [f"{drive}: no segmenter given and no labels found; the map needs one of, for instance:"]
    if find_spec("transformers") is None:
        lines.append(f"  (once before, {how_to_install('hf')})")
    for model, about in (
        ("tue-mps/cityscapes_semantic_eomt_large_1024", "EoMT, best, needs a GPU; MIT licence"),
        (
            "facebook/mask2former-swin-large-cityscapes-semantic",
            "Mask2Former, needs a GPU; licence in its model card",
        ),
        (
            "nvidia/segformer-b1-finetuned-cityscapes-1024-1024",
            "SegFormer, runs on a CPU; NVIDIA, non-commercial licence",
        ),
    ):
        lines.append(
            f"  {program('hf')} download {model} && {program('gnss-sem-map')} run {drive} --segmenter hf:{model} ..."
            f"   ({about})"
        )
    lines.append(
        "For existing labels: --segmenter labels:FOLDER; for the geometry alone: --segmenter none. For several runs,"
        " run `gnss-sem-map segment` once."
    )
    return "\n".join(lines)


def open_segmenter(
    spec: str, label_set: LabelSet, device: str = "auto", sizes: Mapping[str, tuple[int, int]] | None = None
) -> Segmenter:
    """Open a segmenter from its SPEC; as much as possible is checked before the run starts.

    `spec` is one of `SCHEMES`; `sizes` (width, height), px, are those of the images by camera; `device` is auto, cpu,
    cuda or a torch device. Raises ConfigError for a wrong description, DataError for wrong or damaged files.
    """
    scheme, place, options = _parse(spec)
    match scheme:
        case "labels":
            from gnss_sem_map.segmentation.cached import CachedLabels

            return CachedLabels(Path(place), label_set, sizes, **options)
        case "refinenet" | "demo":
            with _needs(scheme, spec):
                from gnss_sem_map.segmentation.checkpoints import open_refinenet
            file = Path(place) if scheme == "refinenet" else DEMO_NETWORK
            return open_refinenet(file, label_set, device, **options)
        case "hf":
            with _needs(scheme, spec):
                from gnss_sem_map.segmentation.huggingface import open_huggingface
            return open_huggingface(place, label_set, device, **options)
        case "onnx":
            with _needs(scheme, spec):
                from gnss_sem_map.segmentation.onnx_file import OnnxSegmenter
            return OnnxSegmenter(Path(place), label_set, device, **options)
        case "python":
            from gnss_sem_map.segmentation.python_callable import PythonSegmenter

            return PythonSegmenter(place, label_set, **options)
    close = difflib.get_close_matches(scheme, SCHEMES, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    raise ConfigError(
        f"segmenter {spec!r}: unknown kind {scheme!r}; {hint}expected none, or one of {list(SCHEMES.values())}"
    )


def _parse(spec: str) -> tuple[str, str, dict[str, str]]:
    if len(spec) > LONGEST_SPEC:
        raise ConfigError(
            f"segmenter {spec[:100]!r}: {len(spec)} characters, at most {LONGEST_SPEC} are read"
        )
    scheme, colon, rest = spec.partition(":")
    place, mark, query = rest.partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    if scheme in SCHEMES and scheme != "demo" and (not colon or not place):
        raise ConfigError(f"segmenter {spec!r}: found nothing after {scheme!r}; expected {SCHEMES[scheme]}")
    if mark and not options:
        raise ConfigError(f"segmenter {spec!r}: found no options after '?', expected a=b&c=d")
    allowed = OPTIONS.get(scheme, tuple(options))
    if unknown := sorted(set(options) - set(allowed)):
        raise ConfigError(f"segmenter {spec!r}: unknown options {unknown}; expected some of {list(allowed)}")
    return scheme, place, options


@contextmanager
def _needs(scheme: str, spec: str) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        extra = EXTRAS[scheme]
        way = how_to_install(extra)
        raise ConfigError(f"segmenter {spec!r}: {error.name} is not installed; {way}") from None
