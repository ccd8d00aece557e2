"""Points that wait on disk come back as they were, and their file goes."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.dynamics.observation import NearPoints
from gnss_sem_map.mapping.waiting_points import WaitingPoints


@pytest.mark.parametrize(("count", "shown"), [(1001, 300), (1001, 0), (1, 1), (0, 0)])
def test_what_waits_comes_back_and_its_file_goes(count: int, shown: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    near = NearPoints(
        indices=np.sort(rng.choice(1 << 20, count, replace=False)).astype(np.int32),
        p_near=rng.normal(size=(count, 3)).astype(np.float32),
        is_body=rng.random(count) < 0.5,
        voxel=rng.integers(-1, 1 << 20, count).astype(np.int32),
    )
    is_shown = np.zeros(count, np.bool_)
    is_shown[rng.choice(count, shown, replace=False)] = True
    waiting = WaitingPoints(
        near,
        keys=rng.integers(0, 1 << 62, count),
        heights=rng.integers(0, 256, count).astype(np.uint8),
        levels=rng.integers(0, 256, count).astype(np.int16),
        moments_us=(1 << 60) + rng.integers(0, 1_000_000, count),
        is_shown=is_shown,
        classes=rng.integers(0, 256, (shown, 6)).astype(np.uint8),
    )
    waiting.write(tmp_path / "scan")
    back = WaitingPoints.take(tmp_path / "scan")
    assert not list(tmp_path.iterdir())
    np.testing.assert_array_equal(back.pixels[is_shown], np.arange(shown))
    assert (back.pixels[~is_shown] == -1).all()
    for written, read in ((near, back.near), (waiting, back)):
        for name in {field.name for field in fields(written)} - {"near"}:
            column = getattr(read, name)
            np.testing.assert_array_equal(column, getattr(written, name))
            assert column.dtype == getattr(written, name).dtype
            assert column.flags.aligned
            assert column.flags.c_contiguous
