"""An ONNX file as a segmenter, run by onnxruntime: no torch needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as state

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.untrusted import is_file, open_file, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.probabilities import resized_softmax
from gnss_sem_map.segmentation.classes import VOID, named_classes
from gnss_sem_map.segmentation.pixels import checked_pixels, scale_and_shrink, scaled
from gnss_sem_map.sensor_log import Image

IMAGENET_MEAN = "0.485,0.456,0.406"
IMAGENET_STD = "0.229,0.224,0.225"
# Numbers between 0 and 1, up to rounding, are probabilities.
ROUNDING = 1e-3

ONNX_ERRORS = (
    state.Fail, state.InvalidArgument, state.InvalidGraph, state.InvalidProtobuf, state.NoModel, state.NoSuchFile,
    state.NotImplemented, state.RuntimeException,
)  # fmt: skip


class OnnxSegmenter:
    """One input (1, 3, h, w) float32, one output (1, c, h', w') of class logits, or of probabilities.

    Other layouts raise DataError.

    The pixels, 0..`pixel_max`, are normalised with `mean` and `std`: three numbers, in the network's channel `order`.
    A network of a fixed input size gets the image resized to it. Class names as in `named_classes`.
    """

    def __init__(
        self,
        path: Path,
        label_set: LabelSet,
        device: str = "auto",
        classes: str | None = None,
        mean: str = IMAGENET_MEAN,
        std: str = IMAGENET_STD,
        order: str = "rgb",
        pixel_max: str = "1",
        scale: str | None = None,
        shrink: str | None = None,
    ) -> None:
        self._path = path
        self._scale, self._shrink = scale_and_shrink(scale, shrink, str(path))
        self._session = _open_session(path, device)
        self._input, self._fixed_size, count = _layout(self._session, path)
        self._mean, self._std = _three_numbers(mean, "mean", path), _three_numbers(std, "std", path)
        if order not in ("rgb", "bgr") or pixel_max not in ("1", "255") or not (self._std > 0).all():
            raise ConfigError(
                f"{path}: found order {order}, pixel_max {pixel_max}, std {std}; expected rgb|bgr, 1|255, positive"
            )
        self._order, self._unit = (
            (0, 1, 2) if order == "rgb" else (2, 1, 0),
            np.float32(255 / float(pixel_max)),
        )
        names = named_classes(classes, count, label_set, str(path))
        self._kept = [i for i, name in enumerate(names) if name != VOID]
        self.class_names = tuple(names[i] for i in self._kept)

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Class probabilities (h, w, c) of one image; raises DataError when the network fails or gives no numbers."""
        pixels = checked_pixels(image)
        height, width = (side // self._shrink for side in pixels.shape[:2])
        seen = scaled(pixels, self._shrink, self._scale, self._fixed_size)
        normalised = (seen[:, :, self._order] / self._unit - self._mean) / self._std
        batch = np.ascontiguousarray(normalised.transpose(2, 0, 1)[None], np.float32)
        try:
            logits = self._session.run(None, {self._input: batch})[0][0]
        except ONNX_ERRORS as error:
            raise DataError(f"{self._path} on image {image.number}: {_first_line(error)}") from None
        if not np.isfinite(logits).all():
            raise DataError(
                f"{self._path} on image {image.number}: logits are not finite; is the normalisation right?"
            )
        return resized_softmax(_as_logits(np.asarray(logits, np.float32))[self._kept], (height, width))


def _as_logits(output: NDArray[np.float32]) -> NDArray[np.float32]:
    """Logits (c, h, w) whose softmax is the output where that is probabilities: a softmax or a sigmoid is in the file.

    Logits of a whole image are hardly ever all between 0 and 1.
    """
    if output.min() < -ROUNDING or output.max() > 1 + ROUNDING:
        return output
    return np.log(np.maximum(output, np.finfo(np.float32).tiny))


def _open_session(path: Path, device: str) -> Any:
    if not is_file(path):
        raise DataError(f"onnx {shown(path)}: no such file")
    with os.fdopen(open_file(path), "rb"):
        pass  # its error gives the reason
    wanted = (
        ["CPUExecutionProvider"] if device == "cpu" else ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
    available = [provider for provider in wanted if provider in onnxruntime.get_available_providers()]
    if device.startswith("cuda") and "CUDAExecutionProvider" not in available:
        raise ConfigError(
            f"device {device!r}: this onnxruntime has no CUDA; pip install onnxruntime-gpu, or use cpu"
        )
    if device not in ("auto", "cpu") and not device.startswith("cuda"):
        raise ConfigError(f"device {device!r}: expected auto, cpu or cuda")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads do not spin
    try:
        return onnxruntime.InferenceSession(path, options, available)
    except ONNX_ERRORS as error:
        raise DataError(
            f"onnx {shown(path)}: cannot be read ({_first_line(error)}); export it again"
        ) from None


def _layout(session: Any, path: Path) -> tuple[str, tuple[int, int] | None, int]:
    """Name of the input, its (height, width) if fixed, and the number of classes."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    taken, given = inputs[0].shape, outputs[0].shape
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(taken) != 4 or taken[1] != 3:
        found = [(i.name, i.type, i.shape) for i in inputs]
        raise DataError(f"onnx {path}: found inputs {found}, expected one of float (1, 3, height, width)")
    if outputs[0].type != "tensor(float)" or len(given) != 4 or not isinstance(given[1], int) or given[1] < 2:
        raise DataError(
            f"onnx {path}: found output {outputs[0].type} {given}, expected float (1, classes, height, width): export"
            " the logits, not the class of each pixel"
        )
    if isinstance(taken[0], int) and taken[0] != 1:
        raise DataError(f"onnx {path}: found a fixed batch of {taken[0]}, expected 1 or any")
    fixed = (taken[2], taken[3]) if isinstance(taken[2], int) and isinstance(taken[3], int) else None
    return inputs[0].name, fixed, given[1]


def _three_numbers(text: str, name: str, path: Path) -> NDArray[np.float32]:
    try:
        numbers = np.array([float(number) for number in text.split(",")], np.float32)
        if numbers.shape != (3,) or not np.isfinite(numbers).all():
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"onnx {path}: found {name}={text}, expected three numbers joined by commas"
        ) from None
    return numbers


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
