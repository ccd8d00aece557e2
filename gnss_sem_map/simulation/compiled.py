"""How the simulator's loops are compiled, and the arrays they take.

They are compiled once, kept on disk, and run without the interpreter's lock. They allocate nothing, so reference counts
are switched off: counting alone would double the time of a ray and make threads wait for each other. No fastmath: the
same operations in the same order give the same bits everywhere. What is small, and what takes a whole scene, is
`inlined` by LLVM: handing over a hundred words costs more than a normal. (Inlined by numba, it is compiled for longer.)
"""

from collections.abc import Callable
from typing import Any, Final, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Numbers = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Triple = tuple[float, float, float]

_F = TypeVar("_F", bound=Callable[..., Any])


class _Compile(Protocol):
    def __call__(self, function: _F, /) -> _F: ...


_OPTIONS: Final[dict[str, Any]] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
kernel: Final[_Compile] = njit(**_OPTIONS)
inlined: Final[_Compile] = njit(**_OPTIONS, forceinline=True)


def kernel_of(signature: str) -> _Compile:
    """A kernel of these types only: without, one that many call is compiled for every mixture of theirs."""
    return cast("_Compile", njit(signature, **_OPTIONS))
