"""An earlier result at OUT, the command that replaces it soonest, and what a refusal must be."""

from __future__ import annotations

from pathlib import Path

from faults.harness import Outcome, gnss_sem_map
from faults.killing import content, write_result
from street import Street

from gnss_sem_map.files.ownership import MARKER

RUN = {
    "run.json": "{}",
    "config.yaml": "a: 1",
    "map/map.json": "{}",
    "map/0_-1.parquet": "x",
    "labels/7.label": "",
}
"""Files of an earlier result."""


def trajectory(street: Street, out: Path | str, folder: Path, **more) -> Outcome:
    """The command that writes a result soonest."""
    return gnss_sem_map("trajectory", street.drive, "-o", out, folder=folder, **more)


def refused(outcome: Outcome, before: dict[str, str], place: Path, named: str) -> list[str]:
    """What is wrong with a refusal: it takes no time, names what is in the way, and changes nothing."""
    faults = list(outcome.faults)
    faults += [f"exit code {outcome.code}"] * (outcome.code != 1)
    faults += [f"does not name {named}"] * (named not in outcome.err)
    faults += ["something was changed"] * (content(place) != before)
    return faults


def result_at(out: Path, listed: bool) -> None:
    write_result(out, RUN)
    if not listed:
        (out / MARKER).unlink()
