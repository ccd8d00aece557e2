"""The README's Python snippets run as they stand, and its paths exist."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import street
from smfeval.io.load import load_estimate
from street import Street

from factor_graphs.accuracy import coverage, nees
from factor_graphs.csv_log import GNSS_COLUMNS, IMU_COLUMNS
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # evo's imports warn, not we
    from evo.tools import file_interface

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.mark.slow
def test_the_snippets_run(
    small_drive: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "PROBABILITIES").symlink_to(small_drive.labels)
    log = street.write_table_log(tmp_path / "table", small_drive)
    for name in ("log", "drive"):
        (tmp_path / name).symlink_to(log)
    for snippet in SNIPPETS:
        exec(compile(snippet, "README.md", "exec"), {})
    assert (tmp_path / "other" / "map.laz").is_file()
    assert len(capsys.readouterr().out.splitlines()) > 1


def test_two_tables_become_files_that_others_read_and_nothing_of_the_map_is_loaded(tmp_path: Path) -> None:
    """The first snippet, in a process of its own, with warnings as errors."""
    frame, rng = LocalFrame(49.0, 8.4, 115.0), np.random.default_rng(5)
    motion = random_drive(60.0, rng)
    imu = simulate_imu(motion, np.arange(0.0, 60.0, 0.01), frame, ImuNoise(), rng)
    fixes = simulate_gnss(motion, np.arange(0.37, 59.0), (1.0, 1.0, 2.0), rng=rng)
    (tmp_path / "log").mkdir()
    for name, columns, values in (
        ("imu", IMU_COLUMNS, [imu.stamps, *imu.specific_force.T, *imu.angular_rate.T]),
        ("gnss", GNSS_COLUMNS, [fixes.stamps, *frame.to_geodetic(fixes.positions), *fixes.stddevs.T]),
    ):
        table = np.column_stack(values)
        path = tmp_path / "log" / f"{name}.csv"
        np.savetxt(path, table, "%.12g", ",", header=",".join(columns), comments="")

    loaded = "import sys; print([name for name in sys.modules if name.startswith('gnss_sem_map')])"
    command = [sys.executable, "-W", "error", "-c", f"{SNIPPETS[0]}\n{loaded}"]
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True
    )
    assert (done.stdout, done.stderr) == (b"[]\n", b"")

    _, steps = load_estimate(tmp_path / "trajectory_covariance.tum", body_frame="imu")
    plain = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(plain.timestamps, [step.timestamp for step in steps])
    np.testing.assert_array_equal(plain.positions_xyz, [step.translation for step in steps])
    at_origin = LocalFrame(*(float(value[0]) for value in frame.to_geodetic(fixes.positions[:1])))
    truth = motion.trajectory(plain.timestamps).moved(at_origin.pose_of(frame))
    off = np.einsum("kji,kj->ki", truth.T_map_imu[:, :3, :3], plain.positions_xyz - truth.positions)
    squares = nees(off, [step.covariance[:3, :3] for step in steps])  # translation first, in imu axes
    assert coverage(squares, 3).inside[2] > 0.8
    assert np.sqrt(np.mean(off**2)) < 0.6, "an axis is no better than a fix, which has 1 m"
    assert (tmp_path / "trajectory.png").read_bytes().startswith(b"\x89PNG")


def test_every_path_that_is_named_exists() -> None:
    named = re.findall(
        r"(?:\(|`|\s)((?:docs|examples|benchmarks|gnss_sem_map|factor_graphs|tests)/[\w./-]*\w)", README
    )
    assert len(named) > 5
    assert [path for path in named if not (ROOT / path).exists()] == []
