"""Drive logs (GNSS, IMU, LiDAR, camera) in, a clean, georeferenced, semantic 3D map out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gnss_sem_map.files.kernel_cache import find_kernel_cache

if TYPE_CHECKING:
    from gnss_sem_map.runs.finished_run import Run, Settings, open_drive, run

__all__ = ["Run", "Settings", "open_drive", "run"]

find_kernel_cache()  # before numba is imported


def __getattr__(name: str) -> Any:
    # imported when first asked for: the command line must answer --help at once
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.runs.finished_run"), name)
