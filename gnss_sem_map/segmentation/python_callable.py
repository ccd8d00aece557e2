"""Any Python callable as a segmenter: RGB pixels (h, w, 3) uint8 in, class probabilities (h', w', c) out."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, errors_of_others, one_line
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.probabilities import checked_probabilities, shrink_of
from gnss_sem_map.segmentation.classes import VOID, named_classes
from gnss_sem_map.segmentation.pixels import checked_pixels, named
from gnss_sem_map.sensor_log import Image


class PythonSegmenter:
    """Calls `module:callable`, with class names from its attribute `class_names` or from `classes`.

    Raises ConfigError when there is no such callable or it has no class names; DataError, at the call, when
    it does not return the probabilities of one image.
    """

    def __init__(self, place: str, label_set: LabelSet, classes: str | None = None) -> None:
        self._where = f"python:{place}"
        self._function = _import(place)
        own: Sequence[str] | None = getattr(self._function, "class_names", None)
        if own is not None and not (isinstance(own, Sequence) and all(isinstance(name, str) for name in own)):
            raise ConfigError(f"{self._where}: found class_names {str(own)[:100]}, expected a list of names")
        if classes is None and own is None:
            raise ConfigError(f"{self._where} has no class_names; set them, or use ?classes=road,...")
        names = named_classes(classes, None if own is None else len(own), label_set, self._where, own)
        self._count, self._kept = len(names), [i for i, name in enumerate(names) if name != VOID]
        self.class_names = tuple(names[i] for i in self._kept)

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        """Class probabilities (h, w, c) of one image."""
        pixels = checked_pixels(image)
        where = f"{self._where} on image {image.number}"
        with errors_of_others(f"{self._where} on {named([image], pixels)}: ", named=True):
            answer = np.asarray(self._function(pixels))
        seen = checked_probabilities(answer, self._count, where)
        shrink_of(seen.shape, (pixels.shape[1], pixels.shape[0]), where)
        return seen if len(self._kept) == self._count else seen[:, :, self._kept]


def _import(place: str) -> Callable[[NDArray[np.uint8]], Any]:
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        raise ConfigError(f"python:{place}: expected python:package.module:callable")
    try:
        function = getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        own = f"{module}.".startswith(f"{error.name}.")  # else one that it imports
        advice = "is its folder on PYTHONPATH?" if own else "it imports that: install it"
        raise ConfigError(f"python:{place}: {error}; {advice}") from None
    except AttributeError:
        raise ConfigError(f"python:{place}: module {module!r} has no {name!r}") from None
    except Exception as error:  # and so may the import of its module
        raise ConfigError(f"python:{place}: cannot be imported ({one_line(error)})") from error
    if not callable(function):
        raise ConfigError(f"python:{place}: found {type(function).__name__}, expected a callable")
    return cast("Callable[[NDArray[np.uint8]], Any]", function)
