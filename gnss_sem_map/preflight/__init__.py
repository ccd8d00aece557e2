"""Pre-flight check: a log is tested against physics, and its sensors against each other, before any work.

`check` runs every check of this folder on a small sample of the drive. A known wrong sensor
convention makes a check amber or red if the drive shows it; the finding names the probable mistake and the setting that
corrects it.
"""

from __future__ import annotations

import time
from dataclasses import replace

from gnss_sem_map.config import Settings
from gnss_sem_map.preflight import camera, inertial, lidar_pair, positions, sweeps, wheels
from gnss_sem_map.preflight.findings import Finding, Level, Preflight, PreflightError
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.process.thread_pools import thread_pool, unless_left
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.sensor_log.conventions import SensorConventions


def check(
    log: SensorLog, settings: Settings, segmenter: Segmenter | None = None, *, with_camera: bool = True
) -> Preflight:
    """Every check that the sensors of a drive allow; raises nothing for what it finds wrong.

    `with_camera` is for runs that use no image: a wrong camera cannot make their map wrong.
    """
    start = time.perf_counter()
    sample = Sample(log.in_our_conventions(settings.sensors), settings, segmenter)
    groups = (inertial, positions, wheels, sweeps, lidar_pair, *((camera,) if with_camera else ()))
    _ = sample.trajectory  # most checks need it: known before they run side by side
    with thread_pool(2) as pool:
        found = list(pool.map(lambda group: unless_left(lambda: tuple(group.check(sample))), groups))
    chosen = SensorConventions() if log.conventions is None else settings.sensors.over(log.conventions)
    findings = tuple(_on_top(finding, chosen) for some in found for finding in some)
    lag = None if sample.diagnosis is None else sample.diagnosis.lag
    told = lag.seconds if lag is not None and (lag.is_certain or lag.observable) else None
    return Preflight(findings, time.perf_counter() - start, sample.whole_solution, told)


def _on_top(finding: Finding, chosen: SensorConventions) -> Finding:
    """The finding; a remedy for what is set says so: the checks look at what the settings have made of the data."""
    is_set = chosen.model_dump(exclude_none=True).items()
    named = [f"{key}: {value}" for key, value in is_set if f"set {key}: " in finding.remedy]
    if not named:
        return finding
    return replace(
        finding, remedy=f"{finding.remedy}; this is on top of {' and '.join(named)}, which is set now"
    )


def check_drive(
    log: SensorLog, segmenter: Segmenter | None, settings: Settings, stats: RunStats, force: bool = False
) -> Preflight:
    """The pre-flight check; amber findings, and red ones with `force`, become warnings. Raises PreflightError."""
    with stats.stage("preflight"):
        page = check(log, settings, segmenter, with_camera=segmenter is not None)
    if page.level is Level.RED and not force:
        raise PreflightError(log.name, page)
    stats.warnings.extend(str(finding) for finding in (*page.of(Level.RED), *page.of(Level.AMBER)))
    return page
