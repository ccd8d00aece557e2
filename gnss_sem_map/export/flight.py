"""A moving picture: the map as it passes below a camera that follows the vehicle."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import NO_VOXELS, Exported
from gnss_sem_map.export.pictures import FIELD_OF_VIEW_DEG, colours_by_night, driven_m, lit_view
from gnss_sem_map.export.render import Camera
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch

SIZE_PX = (640, 360)
FRAME_MS = 80
STEP_M = 1.2
"""The camera's way between two frames: 15 m/s."""
MOST_FRAMES = 80
"""The picture ends then: 6.4 s, and some 1.5 MB."""
BEHIND_M, ABOVE_M, AHEAD_M, BELOW_M = 13.0, 10.0, 24.0, 2.0
"""Along the track from the vehicle to the eye and to the point that it looks at, and heights over the track."""
SMOOTHED_M = 12.0
"""Half of the way over which the camera's way is averaged: it turns before a bend, and not at once."""
QUALITY = 35
"""Of WebP: some 20 kB a frame."""


def write_flight(exported: Exported, path: Path | str) -> None:
    """Fly over the map behind the vehicle of the longest track, as animated WebP, one frame every 1.2 m of way.

    Raises DataError for a map that is empty or has no track, and when the file cannot be written.
    """
    if not exported.extent.count:
        raise DataError(NO_VOXELS)
    if not exported.tracks:
        raise DataError("flight: the map has no track to fly along")
    longest = max(exported.tracks, key=lambda track: float(driven_m(track)[-1]))
    palette = colours_by_night(exported)
    drawn = prefetch(lambda camera: lit_view(exported, palette, camera), cameras(longest), threads())
    frames = (Image.fromarray(pixels) for _, pixels in drawn)
    first = next(frames)
    with replacing(path) as file:
        first.save(
            file, "webp", save_all=True, append_images=frames, duration=FRAME_MS, loop=0, quality=QUALITY
        )


def cameras(track: Trajectory) -> Iterator[Camera]:
    """Cameras over the track, as a vehicle would meet them that drives at constant speed."""
    along = driven_m(track)
    first, last = BEHIND_M, along[-1] - AHEAD_M
    vehicle = np.arange(first, max(last, first + STEP_M), STEP_M)[:MOST_FRAMES]
    eyes, targets = _on_track(track, vehicle - BEHIND_M), _on_track(track, vehicle + AHEAD_M)
    eyes[:, 2] += ABOVE_M
    targets[:, 2] -= BELOW_M
    for eye, target in zip(eyes, targets, strict=True):
        yield Camera(eye, target, *SIZE_PX, FIELD_OF_VIEW_DEG)


def _on_track(track: Trajectory, way_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) m of the smoothed track after so much way; before and after the track straight on."""
    along = driven_m(track)
    reach = np.linspace(-SMOOTHED_M, SMOOTHED_M, 25)
    at = way_m[:, None] + reach
    inside = np.clip(at, 0, along[-1])
    points = np.stack([np.interp(inside, along, axis) for axis in track.positions.T], axis=-1)
    forward = track.T_map_imu[[0, -1], :3, 0]
    points += (
        np.minimum(at, 0)[..., None] * forward[0] + np.maximum(at - along[-1], 0)[..., None] * forward[1]
    )
    smoothed: NDArray[np.float64] = points.mean(axis=1)
    return smoothed
