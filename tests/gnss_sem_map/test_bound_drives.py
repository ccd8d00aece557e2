"""Two days in one street: the surfaces of both drives come together, whichever way the second one is added."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.bound_drives import groups_of
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, remove_drive, run_drives
from gnss_sem_map.simulation import simulate

pytestmark = pytest.mark.integration

SECONDS, SEED = 8.0, 5
HOW = HowMapped(force=True)
OF_MOMENT = ("run.json", "report.html", ".gnss-sem-map.json")


def products(out: Path) -> dict[str, bytes]:
    """All files but those that hold times and memory."""
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name not in OF_MOMENT]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same street on two days; read only."""
    folder = tmp_path_factory.mktemp("days")
    return [simulate(folder, SECONDS, SEED, session=session) for session in (0, 1)]


@pytest.fixture(scope="module")
def both(days: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of both; read only."""
    out = tmp_path_factory.mktemp("made") / "both"
    run_drives(days, out, Settings(), HOW)
    return out


def truth_of(drive: Path) -> Trajectory:
    rows = np.loadtxt(drive / "truth" / "trajectory.tum")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4]
    return Trajectory(rows[:, 0], T)


def between(days: list[Path], tracks: list[Trajectory], frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
    """How the second day's track lies to the first one's, and should: offsets where it is nearest, (k, 3) m."""
    true = []
    for drive in days:
        log = open_drive(drive, with_imu=False)
        assert log.frame is not None
        true.append(truth_of(drive).moved(frame.pose_of(log.frame)))
    stamps = [np.arange(track.start + 0.5, track.end - 0.5, 0.5) for track in true]
    at = [track.at(of_day)[:, :3, 3] for track, of_day in zip(true, stamps, strict=True)]
    near = np.linalg.norm(at[0][None] - at[1][:, None], axis=2).argmin(axis=1)
    found = [track.at(of_day)[:, :3, 3] for track, of_day in zip(tracks, stamps, strict=True)]
    return found[1] - found[0][near], at[1] - at[0][near]


def tracks_in(out: Path, days: list[Path]) -> list[Trajectory]:
    return [Trajectory.load(out / "drives" / drive.name / "trajectory.parquet") for drive in days]


def test_both_days_lie_to_each_other_as_they_were_driven(
    days: list[Path], both: Path, tmp_path: Path
) -> None:
    about = read_run(both)
    (row,) = about["passes"]
    assert [row["first"], row["second"]] == [drive.name for drive in days]
    assert row["bound"] >= 3
    assert row["after_m"] < 0.02 < row["before_m"]
    frame = LocalFrame(**about["local_frame"])
    found, true = between(days, tracks_in(both, days), frame)
    assert np.linalg.norm(found - true, axis=1).max() < 0.03

    apart = Settings.model_validate({"trajectory": {"revisits": {"enabled": False}}})
    run_drives(days, tmp_path / "apart", apart, HOW)
    assert read_run(tmp_path / "apart")["passes"] == []
    found, true = between(days, tracks_in(tmp_path / "apart", days), frame)
    assert np.linalg.norm(found - true, axis=1).min() > 0.1


def test_a_day_that_is_added_moves_the_first_one_as_a_run_of_both_does(
    days: list[Path], both: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    finished_run.run(days[0], out, None, Settings(), force=True)
    alone = products(out)
    add_drive(out, days[1], HOW)
    found, expected = products(out), products(both)
    assert [name for name in expected if found.get(name) != expected[name]] == []
    assert found.keys() == expected.keys()
    remove_drive(out, days[1].name)
    assert products(out)[f"drives/{days[0].name}/trajectory.tum"] == alone["trajectory.tum"]


def test_a_drive_is_not_added_where_one_that_it_moves_is_gone(days: list[Path], tmp_path: Path) -> None:
    date = tmp_path / days[0].parent.name
    shutil.copytree(days[0].parent, date)
    out = tmp_path / "out"
    finished_run.run(date / days[0].name, out, None, Settings(), force=True)
    before = products(out)
    shutil.rmtree(date)
    with pytest.raises(DataError, match=f"stays as it was; {days[0].name} passes the same places"):
        add_drive(out, days[1], HOW)
    assert products(out) == before


def test_tracks_are_grouped_by_where_they_come_near() -> None:
    x = np.arange(0.0, 500.0, 3.0)
    way = np.column_stack([x, 0 * x, 0 * x])
    tracks = {
        "d": way + np.array([0.0, 4000.0, 0.0]),
        "a": way,
        "c": way + np.array([450.0, 30.0, 0.0]),
        "b": way + np.array([900.0, 40.0, 0.0]),
        "e": way + np.array([0.0, 200.0, 0.0]),
    }
    assert groups_of(tracks) == [["a", "b", "c"], ["d"], ["e"]]
    assert groups_of({}) == []
