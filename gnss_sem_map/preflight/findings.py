"""Findings of the pre-flight check: one per check; amber and red ones name the probable mistake and its remedy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from factor_graphs.smoothing import Solution
from gnss_sem_map.errors import DataError

ONE_CLOCK = (
    "give all stamps in seconds of one clock; of a topic of a bag, `stamps: received` in rig.yaml takes the times of"
    " arrival"
)
"""The remedy where one sensor has another clock than the others."""
NOTABLE_LAG_S = 0.25
"""From here a time offset of the fixes is told of, s: noise of metres hides less."""


class Level(StrEnum):
    """Severity of a finding: green is good, amber is doubtful, red would make a wrong map."""

    GREEN = "green"
    AMBER = "amber"
    RED = "red"


@dataclass(frozen=True)
class Finding:
    """The result of one check; `mistake` and `remedy` are empty where it is green."""

    check: str
    """Name of the check, such as "IMU axes"."""
    level: Level
    evidence: str
    """What was found and what was expected, with figures and units."""
    mistake: str = ""
    """The probable mistake: "z points down: FRD axes"."""
    remedy: str = ""
    """The setting that corrects it: "set imu_axes: frd"."""

    def __str__(self) -> str:
        parts = (f"{self.check}: {self.evidence}", self.mistake, self.remedy)
        return "; ".join(part for part in parts if part)


@dataclass(frozen=True)
class Preflight:
    """All findings of a drive, in the order of the checks."""

    findings: tuple[Finding, ...]
    seconds: float
    solution: Solution | None = None
    """First smoothed trajectory of the drive, where the checks computed it; else None."""
    gnss_lag_s: float | None = None
    """By how much a fix is later than its stamp, s; None: the checks cannot tell."""

    @property
    def level(self) -> Level:
        """The worst of the findings; green when there is none."""
        found = {finding.level for finding in self.findings}
        return next((level for level in (Level.RED, Level.AMBER) if level in found), Level.GREEN)

    def of(self, level: Level) -> tuple[Finding, ...]:
        """The findings of one level."""
        return tuple(finding for finding in self.findings if finding.level is level)

    def other_clock(self, offset_s: float) -> str | None:
        """What is to be said of a smoother that finds the fixes `offset_s` s after their stamps; None: they agree."""
        if self.gnss_lag_s is None or abs(self.gnss_lag_s - offset_s) < NOTABLE_LAG_S:
            return None
        return (
            f"the fixes are {offset_s:+.2f} s after their stamps in the trajectory, {self.gnss_lag_s:+.2f} s by the"
            " pre-flight: they disagree; check axes and clock of the IMU, or set gnss_time_offset_s"
        )

    def as_dict(self) -> dict[str, Any]:
        """The page as run.json holds it."""
        return {
            "level": str(self.level),
            "seconds": round(self.seconds, 3),
            "findings": [asdict(finding) for finding in self.findings],
        }


class PreflightError(DataError):
    """The pre-flight check has a red finding; `page` holds all findings."""

    def __init__(self, name: str, page: Preflight) -> None:
        red = page.of(Level.RED)
        more = f" (and {len(red) - 1} more, see `gnss-sem-map check`)" if len(red) > 1 else ""
        super().__init__(f"{name}: the pre-flight is red: {red[0]}{more}; correct it, or run with --force")
        self.page = page


def green(check: str, evidence: str) -> Finding:
    """A finding without a problem."""
    return Finding(check, Level.GREEN, evidence)


def amber(check: str, evidence: str, mistake: str, remedy: str) -> Finding:
    """A doubtful finding."""
    return Finding(check, Level.AMBER, evidence, mistake, remedy)


def red(check: str, evidence: str, mistake: str, remedy: str) -> Finding:
    """A finding that would make a wrong map."""
    return Finding(check, Level.RED, evidence, mistake, remedy)
