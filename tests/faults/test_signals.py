"""Ctrl-C, kill and a closed terminal: one line that says how to go on, 128 and the signal, and nothing left."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from faults.harness import gnss_sem_map
from faults.killing import content
from street import Street


def stop(
    street: Street, number: signal.Signals, after_s: float, folder: Path, *more: str, segmenter: str = ""
) -> tuple[list[str], object]:
    """Stop a run after some seconds; what is wrong with its end, and how it ended."""
    labels = segmenter or f"labels:{street.labels}"
    words = ("run", street.drive, "--segmenter", labels, "--set", "dynamics.window_scans=1", *more)
    outcome = gnss_sem_map(*words, "-o", folder / "out", folder=folder / "trial", interrupt=(after_s, number))
    faults = list(outcome.faults)
    if outcome.code == 0:
        return [*faults, *["no result"] * (not (folder / "out/run.json").is_file())], outcome
    faults += [f"code {outcome.code}"] * (outcome.code != 128 + number)
    if (folder / "out/run.json").is_file():  # it came after the whole result was put in its place
        return faults, outcome
    faults += ["a result"] * (folder / "out").exists()
    beside = {path.name for path in folder.iterdir()} - {"trial"}
    kept = any(re.search(r"record\.json$|^matches/\d+\.npz$", name) for name in content(folder / ".out.work"))
    faults += [f"left {beside}"] * (beside != ({".out.work"} if kept else set()))
    faults += ["does not name --resume"] * (kept and "--resume" not in outcome.err)
    faults += ["names --resume, but nothing is kept"] * (not kept and "--resume" in outcome.err)
    return faults, outcome


@pytest.mark.parametrize(
    ("number", "after_s"),
    [
        (signal.SIGTERM, 1.5),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((signal.SIGINT, 0.3), (signal.SIGHUP, 3.0))),
    ],
)
def test_a_signal_is_one_line(small_drive: Street, number, after_s: float, trial, tmp_path: Path) -> None:
    trial("signals", *stop(small_drive, number, after_s, tmp_path))


@pytest.mark.slow
def test_a_signal_to_all_workers_is_one_line(small_drive: Street, trial, tmp_path: Path) -> None:
    trial("signals", *stop(small_drive, signal.SIGINT, 5.0, tmp_path, "--workers", "2"))


@pytest.mark.slow
@pytest.mark.parametrize(("command", "after_s"), [("segment", 2.0), ("run", 6.0)])
def test_a_signal_ends_a_network_that_never_answers(
    small_drive: Street, command: str, after_s: float, trial, tmp_path: Path
) -> None:
    """Threads wait for the network, and cannot be stopped: nothing waits for them."""
    network = "python:faults.slow_network:never"
    if command == "run":
        trial("signals", *stop(small_drive, signal.SIGINT, after_s, tmp_path, segmenter=network))
        return
    words = (command, small_drive.drive, "--segmenter", network, "-o", tmp_path / "out")
    outcome = gnss_sem_map(*words, folder=tmp_path / "trial", interrupt=(after_s, signal.SIGINT))
    faults = [*outcome.faults, *[f"code {outcome.code}"] * (outcome.code != 128 + signal.SIGINT)]
    trial("signals", [*faults, *["locked"] * (tmp_path / ".out.lock").exists()], outcome)


@pytest.mark.faults
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_at_any_moment_is_one_line(small_drive: Street, number, trial, tmp_path: Path) -> None:
    for step in range(12):
        folder = tmp_path / f"{step}"
        folder.mkdir()
        workers = ("--workers", "2") if step % 3 == 2 else ()
        trial("signals", *stop(small_drive, number, 0.2 + 0.5 * step, folder, *workers))
