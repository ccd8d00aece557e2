"""A torch network as a segmenter, on a CPU or a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.nn.utils.fusion import fuse_conv_bn_eval

from gnss_sem_map.errors import ConfigError, DataError, errors_of_others
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.process.memory import reuse_memory
from gnss_sem_map.segmentation.classes import VOID
from gnss_sem_map.segmentation.pixels import checked_pixels, named, scaled
from gnss_sem_map.sensor_log import Image

Probabilities = Callable[[Tensor, tuple[int, int]], Tensor]
"""Normalised images (b, 3, h, w) and the wanted (height, width) -> class probabilities (b, c, height, width)."""

Prepare = Callable[[NDArray[np.uint8]], Tensor]
"""RGB pixels (b, h, w, 3) -> images (b, 3, h, w) as the network expects them."""


class NetworkSegmenter:
    """Runs a network at `scale` times the image's size; its output has the image's size divided by `shrink`.

    The remainder of that division at the right and lower border (less than `shrink` pixels) is not segmented. Raises
    DataError with the `name` of the network for an image that is not (h, w, 3) uint8, for any error inside the network,
    for probabilities that are not finite, or when the device's memory is full.
    """

    def __init__(
        self,
        name: str,
        probabilities: Probabilities,
        class_names: Sequence[str],
        device: torch.device,
        prepare: Prepare,
        scale: float = 1.0,
        shrink: int = 2,
    ) -> None:
        self.class_names = tuple(class_names)
        self._name, self._probabilities, self._device = name, probabilities, device
        self._prepare, self._scale, self._shrink = prepare, scale, shrink
        # torch prepares every layer anew for each thread that uses a GPU, and a batch of each would fill its memory
        self._gpu_thread = None if device.type == "cpu" else ThreadPoolExecutor(1)
        if self._gpu_thread is None:
            reuse_memory()

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Class probabilities (h, w, c) of one image."""
        return self.segment_many([image])[0]

    @property
    def threads(self) -> int:
        """One per core: on a CPU, cores that share an image would wait for each other; while a GPU computes, the others
        read images and write probabilities."""
        return torch.get_num_threads()

    def on_one_core(self, images: Sequence[Image]) -> list[NDArray[np.float32]]:
        """Class probabilities of several images, as `segment_many`, by the calling thread alone."""
        torch.set_num_threads(1)  # of this thread
        return self.segment_many(images)

    def segment_many(self, images: Sequence[Image]) -> list[NDArray[np.float32]]:
        """Class probabilities of several images of one size in one batch; the same as one by one."""
        pixels = [checked_pixels(image) for image in images]
        if len({p.shape for p in pixels}) > 1:
            return [seen for image in images for seen in self.segment_many([image])]
        height, width = (side // self._shrink for side in pixels[0].shape[:2])
        inputs = np.stack([scaled(p, self._shrink, self._scale) for p in pixels])
        where = f"{self._name} on {named(images, pixels[0])}"
        with errors_of_others(f"{where}: ", named=True):
            if self._gpu_thread is None:
                result = self._run(inputs, (height, width))
            else:
                result = self._gpu_thread.submit(self._run, inputs, (height, width)).result()
        if not np.isfinite(result).all():
            raise refused(where, "the network's probabilities are not finite; are its weights damaged?")
        return [np.ascontiguousarray(one) for one in result]

    def _run(self, pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
        with torch.inference_mode(), enough_memory(self._device, "fewer images at once, or ?scale=0.5"):
            seen = self._probabilities(self._prepare(pixels).to(self._device), size)
            result: NDArray[np.float32] = seen.permute(0, 2, 3, 1).float().cpu().numpy()
        return result


def normalised(mean: Sequence[float], std: Sequence[float], device: torch.device) -> Prepare:
    """What makes pixels, 0 to 1, of that mean and standard deviation (3,) to mean 0 and standard deviation 1."""
    middle, spread = (torch.tensor(values, device=device).reshape(3, 1, 1) for values in (mean, std))

    def prepare(pixels: NDArray[np.uint8]) -> Tensor:
        return (torch.from_numpy(pixels).to(device).permute(0, 3, 1, 2).float() / 255 - middle) / spread

    return prepare


def from_logits(network: Callable[[Tensor], Tensor], class_names: Sequence[str]) -> Probabilities:
    """Probabilities of a network that gives logits at some stride: enlarge, drop void channels, softmax."""
    kept = [i for i, name in enumerate(class_names) if name != VOID]

    def probabilities(images: Tensor, size: tuple[int, int]) -> Tensor:
        logits = interpolate(network(images)[:, kept], size=size, mode="bilinear", align_corners=False)
        return logits.softmax(1)

    return probabilities


def find_device(name: str) -> torch.device:
    """The device of that name; `auto` is a GPU if there is one. Raises ConfigError for a missing one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"device {name!r}: {reason}; expected auto, cpu, cuda or the like") from None
    return device


@contextmanager
def enough_memory(device: torch.device, advice: str) -> Iterator[None]:
    """Raise a DataError with `advice` when the memory of a GPU is full."""
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise DataError(f"device {str(device)!r}: its memory is full; try {advice}") from None


def for_inference(network: nn.Module, device: torch.device) -> nn.Module:
    """The network on its device, for inference only: each normalisation is fused into the convolution before it, which
    gives the same logits up to rounding, in two thirds of the time on a CPU."""
    for module in list(network.eval().modules()):
        for (before, convolution), (name, norm) in pairwise(list(module.named_children())):
            if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(module, before, fuse_conv_bn_eval(convolution, norm))
                setattr(module, name, nn.Identity())
    return placed(network, device)


def placed(network: nn.Module, device: torch.device) -> nn.Module:
    """The network on its device, with weights in the memory format channels-last, which is faster."""
    network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network
