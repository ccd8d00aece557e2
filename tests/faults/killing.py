"""Work that is killed just before its n-th change of the disk: every moment that matters, one after another."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from faults.harness import PRELOAD

CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink"}
KILLED = 137


def killed_before_change(number: int, folder: Path, function: Callable[..., None], *arguments: Any) -> bool:
    """Call a function in a process that dies before its n-th change below a folder; whether it did, or came to an end.

    Raises AssertionError when the function failed for another reason.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    process = context.Process(target=_child, args=(number, str(folder), function, arguments))
    process.start()
    process.join(600)
    assert process.exitcode in (0, KILLED), f"ended with {process.exitcode} at change {number}"
    return process.exitcode == KILLED


def _child(number: int, folder: str, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    changes = 0

    def count(event: str, details: tuple[Any, ...]) -> None:
        nonlocal changes
        if event == "open":
            path, _, flags = details
            if not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR)):
                return
        elif event in CHANGES:
            path = details[0]
        else:
            return
        # names of what is removed through an open folder are relative
        if not isinstance(path, int) and (
            not os.path.isabs(text := os.fsdecode(path)) or text.startswith(folder)
        ):
            changes += 1
            if changes == number:
                os._exit(KILLED)

    sys.addaudithook(count)
    function(*arguments)
    os._exit(0)


def content(folder: Path) -> dict[str, str]:
    """Every file below a folder with the checksum of what is in it."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write_result(out: Path, files: Mapping[str, str]) -> None:
    """A result of ours, as every command writes one."""
    from gnss_sem_map.files.output_folder import new_folder

    with new_folder(out) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def look_in(out: Path) -> None:
    """The next command that writes there, which ends before it has anything to write."""
    from gnss_sem_map.runs.run_folder import claimed_run

    with claimed_run(out):
        pass


def write_run_like(out: Path, files: Mapping[str, str]) -> None:
    """The same where an older version may have written a run without a list."""
    from gnss_sem_map.runs.run_folder import claimed_run

    with claimed_run(out):
        write_result(out, files)


def map_street(drive: Path, probabilities: Path, work: Path) -> None:
    """Map a drive in chunks of four scans into a work folder, going on with what is there."""
    from gnss_sem_map.mapping.fusion import map_scans
    from gnss_sem_map.process.run_stats import RunStats

    map_scans(street_drive(drive, probabilities), work, RunStats(), resume=True)


def street_drive(drive: Path, probabilities: Path) -> Any:
    """A drive with the poses of its own navigation unit, in chunks of four scans."""
    from gnss_sem_map.config import Settings
    from gnss_sem_map.datasets import open_drive
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.mapping.labelled_scans import Drive
    from gnss_sem_map.segmentation import open_segmenter

    log = open_drive(drive)
    spec, size = f"labels:{probabilities}", log.calibration.image_sizes
    segmenter = open_segmenter(spec, open_label_set(), sizes=size)
    assert log.reference is not None
    settings = Settings.model_validate({"dynamics": {"window_scans": 2}})
    return Drive(log, log.reference, segmenter, settings)


def command(words: tuple[str, ...]) -> None:
    """The command line, quietly."""
    from gnss_sem_map.cli import main

    for number in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    sys.argv = ["gnss-sem-map", *words]
    try:
        main()
    except SystemExit as end:
        os._exit(int(end.code or 0))
