"""An ONNX file as a segmenter, run by onnxruntime: no torch needed."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError, errors_of_others
from gnss_sem_map.files.untrusted import is_file, open_file, refused, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.probabilities import of_hard_labels, resized_softmax
from gnss_sem_map.segmentation.classes import BY_COUNT, VOID, named_classes
from gnss_sem_map.segmentation.pixels import checked_pixels, named, scale_and_shrink, scaled, whole_strides
from gnss_sem_map.sensor_log import Image

IMAGENET_MEAN = "0.485,0.456,0.406"
IMAGENET_STD = "0.229,0.224,0.225"
# Numbers between 0 and 1, up to rounding, are probabilities.
ROUNDING = 1e-3

DTYPES = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64, "tensor(uint8)": np.uint8,
}  # fmt: skip
PROBE = (256, 512)
"""(height, width) of the grey image that a network of any size sees on opening."""


class OnnxSegmenter:
    """One input (b, 3, h, w) or (b, h, w, 3); class logits or probabilities (b, c, h', w') or (b, h', w', c), or ids.

    Of several outputs the first of logits is taken. Numbers may have 16, 32 or 64 bits; an input of uint8 gets the
    pixels as they are. Else these, 0..`pixel_max`, are normalised with `mean` and `std`: three numbers, in the
    network's channel `order`. A network of a fixed input size gets the image resized to it, any other one stretched to
    multiples of STRIDE. It is run once on opening. Class names as in `named_classes`; of ids `classes` must tell them.
    Raises DataError for other layouts.
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
        self._mean, self._std = _three_numbers(mean, "mean", path), _three_numbers(std, "std", path)
        if order not in ("rgb", "bgr") or pixel_max not in ("1", "255") or not (self._std > 0).all():
            raise ConfigError(f"{path}: {order=} {pixel_max=} {std=}; expected rgb|bgr, 1|255, above 0")
        self._order, self._unit = (
            (0, 1, 2) if order == "rgb" else (2, 1, 0),
            np.float32(255 / float(pixel_max)),
        )
        told = 0 if classes is None else len(named_classes(classes, None, label_set, str(path)))
        self._input, self._output, self._axis, count = _probed(self._session, path, told)
        names = named_classes(classes, count, label_set, f"onnx {path}")
        self._kept = [i for i, name in enumerate(names) if name != VOID]
        self.class_names = tuple(names[i] for i in self._kept)
        # the last row is of unknown ids
        self._table = np.zeros((len(names) + 1, len(self._kept)), np.float32)
        self._table[self._kept] = of_hard_labels(len(self._kept))

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Class probabilities (h, w, c) of one image; raises DataError when the network fails or gives no numbers."""
        pixels = checked_pixels(image)
        height, width = (side // self._shrink for side in pixels.shape[:2])
        where = f"onnx:{self._path} on {named([image], pixels)}"
        seen: NDArray[Any] = scaled(pixels, self._shrink, self._scale, self._input.whole)[:, :, self._order]
        if self._input.dtype != np.uint8:
            seen = (seen / self._unit - self._mean) / self._std
        with errors_of_others(f"{where}: "):
            answer = self._session.run([self._output], self._input.feed(seen))[0]
        if not np.isfinite(answer).all():
            raise refused(where, "logits are not finite; is the normalisation right?")
        if self._axis is None:
            ids = _plane(answer)
            if ids.ndim != 2 or (ids != np.rint(ids)).any():
                raise refused(where, "found one channel of fractions, expected ids or a channel per class")
            known = np.where((ids >= 0) & (ids < len(self._table) - 1), ids, len(self._table) - 1)
            resized = cv2.resize(known.astype(np.int32), (width, height), interpolation=cv2.INTER_NEAREST)
            return np.asarray(self._table[resized])
        logits = np.moveaxis(np.asarray(answer[0], np.float32), self._axis - 1, 0)
        return resized_softmax(_as_logits(logits)[self._kept], (height, width))


@dataclass(frozen=True)
class _Input:
    """What a network takes."""

    name: str
    dtype: np.dtype[Any]
    last: bool
    """Whether channels are the last axis."""
    batch: int
    size: tuple[int | None, int | None]
    """(height, width), where they are fixed."""

    def whole(self, height: int, width: int) -> tuple[int, int]:
        """A size of images that it takes."""
        return self.size[0] or whole_strides(height), self.size[1] or whole_strides(width)

    def feed(self, pixels: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """One image (h, w, 3), as often as the batch is long."""
        image = pixels if self.last else pixels.transpose(2, 0, 1)
        return {self.name: np.ascontiguousarray(np.repeat(image[None], self.batch, axis=0), self.dtype)}


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
        raise ConfigError(f"device {device!r}: no CUDA here; pip install onnxruntime-gpu, or use cpu")
    if device not in ("auto", "cpu") and not device.startswith("cuda"):
        raise ConfigError(f"device {device!r}: expected auto, cpu or cuda")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads do not spin
    with errors_of_others(f"onnx {shown(path)}: cannot be read (", "); export it again"):
        return onnxruntime.InferenceSession(path, options, available)


def _probed(session: Any, path: Path, told: int) -> tuple[_Input, str, int | None, int | None]:
    """How images go in, which output is taken, the axis of its classes, and their number, as a grey image shows.

    Without an axis it holds class ids.
    """
    port = _input_of(session, path)
    size = port.whole(*PROBE)
    with errors_of_others(f"onnx:{path} on a grey image of {size[1]} x {size[0]} pixels: "):
        answers = session.run(None, port.feed(np.full((*size, 3), 0.5)))
    outputs = [(output.name, answer) for output, answer in zip(session.get_outputs(), answers, strict=True)]
    for name, answer in outputs:
        if answer.ndim == 4 and answer.dtype.kind == "f" and 1 not in (answer.shape[1], answer.shape[3]):
            axis = _axis_of_classes(answer.shape, size, port, told)
            return port, name, axis, answer.shape[axis]
    for name, answer in outputs:
        if answer.dtype.kind in "iuf" and _plane(answer).ndim == 2:
            return port, name, None, None
    found = [(name, answer.dtype.name, answer.shape) for name, answer in outputs]
    raise DataError(
        f"onnx {path}: found outputs {found}, expected float (1, classes, h, w) or (1, h, w, classes), or ids"
    )


def _plane(answer: NDArray[Any]) -> NDArray[Any]:
    return np.squeeze(answer[0] if answer.ndim > 2 else answer)


def _input_of(session: Any, path: Path) -> _Input:
    inputs = session.get_inputs()
    shape = [side if isinstance(side, int) and side > 0 else None for side in inputs[0].shape] or [None] * 4
    dtype, ends = DTYPES.get(inputs[0].type), shape[1:4:2]
    if len(inputs) != 1 or dtype is None or len(shape) != 4 or not (3 in ends or ends == [None, None]):
        found = [(i.name, i.type, i.shape) for i in inputs]
        raise DataError(f"onnx {path}: found {found}, expected one: float (1, 3, h, w) or (1, h, w, 3)")
    last = ends[0] != 3 and (ends[1] == 3 or str(inputs[0].shape[-1:]).lower().startswith("['c"))
    size = (shape[1], shape[2]) if last else (shape[2], shape[3])
    return _Input(inputs[0].name, np.dtype(dtype), last, shape[0] or 1, size)


def _axis_of_classes(shape: tuple[int, ...], size: tuple[int, int], port: _Input, told: int) -> int:
    """1 or 3: the other two axes are as high and wide as the input, or that divided; else the one of a known length."""
    counts = (told,) if told else BY_COUNT

    def doubt(axis: int) -> tuple[bool, bool, bool]:
        height, width = shape[2:] if axis == 1 else shape[1:3]
        out_of_shape = abs(height * size[1] - width * size[0]) > max(size)
        return out_of_shape, shape[axis] not in counts, port.last != (axis == 3)

    return min((1, 3), key=doubt)


def _three_numbers(text: str, name: str, path: Path) -> NDArray[np.float32]:
    try:
        numbers = np.array([float(number) for number in text.split(",")], np.float32)
        if numbers.shape != (3,) or not np.isfinite(numbers).all():
            raise ValueError
    except ValueError:
        raise ConfigError(f"onnx {path}: found {name}={text}, expected three numbers: a,b,c") from None
    return numbers
