"""The flight over the map: where its camera is, and what the file holds."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.flight import (
    ABOVE_M,
    AHEAD_M,
    BEHIND_M,
    BELOW_M,
    MOST_FRAMES,
    STEP_M,
    cameras,
    write_flight,
)
from gnss_sem_map.export.pictures import colours_by_night, lit_view
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory


def straight(length_m: float) -> Trajectory:
    """East at a speed that changes, with a stop in the middle."""
    stamps = np.linspace(0, 10, 500)
    east = length_m * np.interp(stamps, [0, 3, 6, 10], [0, 0.6, 0.6, 1])
    T_map_imu = np.tile(np.eye(4), (len(stamps), 1, 1))
    T_map_imu[:, 0, 3] = east
    return Trajectory(stamps, T_map_imu)


def test_over_a_straight_road_the_camera_moves_by_the_same_step_and_looks_ahead() -> None:
    flown = list(cameras(straight(120)))
    eyes, targets = (np.array([getattr(each, name) for each in flown]) for name in ("eye", "target"))
    np.testing.assert_allclose(np.diff(eyes[:, 0]), STEP_M, atol=1e-6)
    np.testing.assert_allclose(
        targets - eyes, [[AHEAD_M + BEHIND_M, 0, -ABOVE_M - BELOW_M]] * len(flown), atol=1e-6
    )
    assert eyes[0, 0] == pytest.approx(0, abs=1e-6)
    assert 120 - STEP_M <= targets[-1, 0] <= 120


def test_a_long_track_is_flown_over_up_to_a_most_and_a_short_one_has_a_picture() -> None:
    assert [len(list(cameras(straight(length_m)))) for length_m in (1000, 3)] == [MOST_FRAMES, 1]


def test_the_file_is_a_moving_picture_of_what_the_cameras_see(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    exported = Exported(in_memory(street), [track])
    write_flight(exported, tmp_path / "flight.webp")
    flown = list(cameras(track))
    with Image.open(tmp_path / "flight.webp") as picture:
        assert getattr(picture, "n_frames", 1) == len(flown)
        for number in {0, len(flown) - 1}:
            picture.seek(number)
            seen = np.asarray(picture.convert("RGB")).astype(float)
            drawn = lit_view(exported, colours_by_night(exported), flown[number]).astype(float)
            assert np.abs(seen - drawn).mean() < 6  # of 255: what the compression loses


def test_without_a_track_there_is_no_way_to_fly(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no track to fly along"):
        write_flight(Exported(in_memory(street)), tmp_path / "flight.webp")
