"""A map of several drives on a Dask cluster, which goes on with what it has under way when the command is killed."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest
from commands import command, gnss_sem_map
from dask_clusters import started, two_workers
from maps_of_drives import assert_same, run_of
from processes import wait_until
from street_drives import Drives

pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
pytestmark = [pytest.mark.integration, pytest.mark.slow]


def test_a_run_whose_command_is_killed_is_resumed_while_workers_are_still_busy(
    made: dict[str, Path], drives: Drives, tmp_path: Path
) -> None:
    out, work = tmp_path / "out", tmp_path / ".out.work"
    (cluster := tmp_path / "cluster").mkdir()
    with two_workers(cluster) as address:
        words = run_of([drives.by_name["a"], drives.by_name["b"]], drives, out, "--scheduler", address)
        running = subprocess.Popen(command(*words), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert wait_until(lambda: any(work.glob("drives/.*.work/chunks.json")))
        running.kill()
        assert running.wait() == -signal.SIGKILL
        assert not (work / "drives/a/run.json").exists()
        # one that has nothing to do gets the first drive, which is still being mapped
        with started("worker", cluster / "scheduler.json", "--nthreads", "1", "--no-dashboard"):
            done = gnss_sem_map(*words, "--resume")
    assert done.returncode == 0, done.stderr
    assert_same(out, made["ab"])
    assert sorted(os.listdir(tmp_path)) == ["cluster", "out"]
