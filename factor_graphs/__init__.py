"""A GNSS/IMU trajectory from a factor graph, with consistent covariance.

Knows no map and no scans. Read in this order: `csv_log`, `measurements` and `geodesy` (what goes in), `smoothing`
(the graph), `trajectory`, `tum` and `trajectory_plot` (what comes out), `accuracy` (how good it is), `simulation`
(exact truth to test against), `streaming` (fix by fix: `examples/streaming.py`) and `kalman` (the baseline:
`examples/kalman_baseline.py`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factor_graphs.csv_log import read_csv, read_headings, read_points, read_velocities, read_wheels
    from factor_graphs.geodesy import LocalFrame
    from factor_graphs.measurements import AntennaHeadings, GnssFixes, GnssVelocities, ImuSamples, WheelSpeeds
    from factor_graphs.smoothing import smooth
    from factor_graphs.surveyed_points import SurveyedPoints
    from factor_graphs.trajectory import Trajectory
    from factor_graphs.trajectory_plot import write_trajectory_plot
    from factor_graphs.tum import write_covariance_tum, write_tum

__all__ = [
    "AntennaHeadings",
    "GnssFixes",
    "GnssVelocities",
    "ImuSamples",
    "LocalFrame",
    "SurveyedPoints",
    "Trajectory",
    "WheelSpeeds",
    "read_csv",
    "read_headings",
    "read_points",
    "read_velocities",
    "read_wheels",
    "smooth",
    "write_covariance_tum",
    "write_trajectory_plot",
    "write_tum",
]

_PLACES = {
    "AntennaHeadings": "measurements",
    "GnssFixes": "measurements",
    "GnssVelocities": "measurements",
    "ImuSamples": "measurements",
    "LocalFrame": "geodesy",
    "SurveyedPoints": "surveyed_points",
    "Trajectory": "trajectory",
    "WheelSpeeds": "measurements",
    "read_csv": "csv_log",
    "read_headings": "csv_log",
    "read_points": "csv_log",
    "read_velocities": "csv_log",
    "read_wheels": "csv_log",
    "smooth": "smoothing",
    "write_covariance_tum": "tum",
    "write_trajectory_plot": "trajectory_plot",
    "write_tum": "tum",
}


def __getattr__(name: str) -> Any:
    # imported when first asked for: gtsam takes a third of a second
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
