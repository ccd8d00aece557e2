"""Diagnostic plot of a trajectory: track, residuals, standard deviations, biases."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import GnssFixes
from factor_graphs.smoothing import Solution, heading_stddevs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

AXES = ("east", "north", "up")
COLOURS = ("tab:red", "tab:green", "tab:blue")
HEADROOM, PANEL_INCHES = 1.15, 2.5
SHOWN_STDDEVS = 4.0
"""So many usual standard deviations of the separation are shown."""
LINE_SHARE = 0.016
"""Height of a line of the title, of that of the figure."""


def write_trajectory_plot(solution: Solution, fixes: GnssFixes, path: Path | str) -> None:
    """Write track, residuals, standard deviations and biases as one PNG, with fixes that were not used and all notes.

    And the separation of forward and backward solution where it is known.

    `fixes` are those given to the smoother. The file is written where `path` says, whatever its name ends with. Raises
    MeasurementError for other fixes, and OSError when the file cannot be written.
    """
    if len(fixes) != len(solution.rejected):
        raise MeasurementError(
            f"{len(fixes)} fixes, but the solution is of {len(solution.rejected)}: give those that were given to smooth"
        )
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [_residuals, _stddevs, _heading, *([] if solution.separation is None else [_separation])]
    figure, title = Figure(figsize=(15, PANEL_INCHES * (len(panels) + 1)), dpi=110), _title(solution, fixes)
    FigureCanvasAgg(figure)
    # fixed margins: a layout engine would draw everything twice
    edges = {"left": 0.05, "right": 0.93, "bottom": 0.06, "top": 0.96 - LINE_SHARE * (1 + title.count("\n"))}
    grid = figure.add_gridspec(len(panels) + 1, 2, width_ratios=[1.1, 1.0], wspace=0.14, hspace=0.1, **edges)
    _track(figure.add_subplot(grid[:, 0]), solution, fixes)
    below = figure.add_subplot(grid[-1, 1])
    for row, draw in enumerate(panels):
        axes = figure.add_subplot(grid[row, 1], sharex=below)
        axes.tick_params(labelbottom=False)
        draw(axes, solution, fixes)
    _biases(below, solution)
    figure.suptitle(title, fontsize=10, ha="left", x=0.01)
    figure.savefig(path, format="png")


def _title(solution: Solution, fixes: GnssFixes) -> str:
    span = solution.trajectory.end - solution.trajectory.start
    used = int(np.count_nonzero(solution.fix_weights > 0))
    first = f"{span:.0f} s, {used} of {len(fixes)} fixes used, chi2 per degree of freedom {solution.chi2_per_dof:.2f}"
    verdicts = [part.verdict for part in (solution.vehicle, solution.wheels) if part is not None]
    return "\n".join([first, *verdicts, *solution.notes])


def _track(axes: "Axes", solution: Solution, fixes: GnssFixes) -> None:
    positions, rejected = solution.trajectory.positions, solution.rejected
    axes.plot(*positions[:, :2].T, color="black", linewidth=1.2, label="trajectory")
    axes.plot(*fixes.positions[~rejected, :2].T, ".", color="tab:blue", markersize=3, label="fixes")
    axes.plot(*fixes.positions[rejected, :2].T, "x", color="tab:red", markersize=5, label="fixes not used")
    axes.plot(*positions[0, :2], "o", color="tab:green", label="start")
    # a fix kilometres away must not shrink the drive to a dot, and a straight drive needs some width
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    middle, half = (low + high) / 2, 30.0 + 0.55 * float(np.max(high - low))
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.set_aspect("equal", adjustable="box")
    axes.legend(loc="best", fontsize=8)
    axes.grid(alpha=0.3)


def _residuals(axes: "Axes", solution: Solution, fixes: GnssFixes) -> None:
    for name, colour, residual in zip(AXES, COLOURS, solution.fix_residuals.T, strict=True):
        good = ~solution.rejected
        axes.plot(fixes.stamps[good], residual[good], ".", color=colour, markersize=3, label=name)
    limit = 4.0 * float(np.median(fixes.stddevs, axis=0).max()) if len(fixes) else 1.0
    far = np.abs(np.nan_to_num(solution.fix_residuals)).max(axis=1)
    edge = np.full(int(solution.rejected.sum()), limit)
    axes.plot(
        fixes.stamps[solution.rejected],
        np.minimum(edge, far[solution.rejected]),
        "x",
        color="black",
        markersize=4,
    )
    axes.set(ylim=(-1.1 * limit, 1.1 * limit), ylabel="fix - antenna, m")
    axes.legend(loc="upper right", fontsize=7, ncols=3)
    axes.grid(alpha=0.3)


def _stddevs(axes: "Axes", solution: Solution, _fixes: GnssFixes) -> None:
    stddevs = solution.trajectory.position_stddevs
    for name, colour, stddev in zip(AXES, COLOURS, stddevs.T, strict=True):
        axes.plot(solution.trajectory.stamps, stddev, color=colour, linewidth=1, label=name)
    axes.set(ylabel="position stddev, m", ylim=(0.0, HEADROOM * stddevs.max()))
    axes.legend(loc="lower right", fontsize=7, ncols=3)
    axes.grid(alpha=0.3)


def _heading(axes: "Axes", solution: Solution, _fixes: GnssFixes) -> None:
    stddev = np.degrees(heading_stddevs(solution.trajectory))
    axes.plot(solution.trajectory.stamps, stddev, color="tab:purple", linewidth=1)
    axes.set(ylabel="heading stddev, °", ylim=(0.0, HEADROOM * stddev.max()))
    axes.grid(alpha=0.3)


def _separation(axes: "Axes", solution: Solution, _fixes: GnssFixes) -> None:
    """With standard deviations as dots; both ends are cut: there, one of the two solutions knows nothing yet."""
    found = solution.separation
    assert found is not None
    for name, colour, off, stddev in zip(AXES, COLOURS, found.off.T, found.stddevs.T, strict=False):
        axes.plot(found.stamps, off, color=colour, linewidth=1, label=name)
        for sign in (-1, 1):
            axes.plot(found.stamps, sign * stddev, ":", color=colour, linewidth=0.8)
    limit = SHOWN_STDDEVS * float(np.median(found.stddevs[:, :3], axis=0).max())
    axes.set(ylim=(-limit, limit), ylabel="forward - backward, m")
    axes.legend(loc="lower right", fontsize=7, ncols=3)
    axes.grid(alpha=0.3)


def _biases(axes: "Axes", solution: Solution) -> None:
    stamps = solution.keyframes.stamps
    rates = axes.twinx()
    rates.ticklabel_format(axis="y", scilimits=(-2, 3))
    for i, (name, colour) in enumerate(zip("xyz", COLOURS, strict=True)):
        axes.plot(stamps, solution.biases[:, i], color=colour, linewidth=1, label=name)
        rates.plot(stamps, np.degrees(solution.biases[:, 3 + i]), ":", color=colour, linewidth=1.2)
    axes.set(xlabel="time, s", ylabel="accelerometer bias, m/s² (lines)")
    rates.set(ylabel="gyroscope bias, °/s (dots)")
    axes.legend(loc="upper right", fontsize=7, ncols=3)
    axes.grid(alpha=0.3)
