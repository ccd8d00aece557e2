"""Plot of Allan deviations: those of six axes over the cluster time, with the curves that were fitted."""

from collections.abc import Sequence
from typing import BinaryIO

from factor_graphs.allan_deviation import NAMES, UNITS, AxisNoise, terms, worst

COLOURS = {"x": "tab:red", "y": "tab:green", "z": "tab:blue"}


def write_allan_plot(axes: Sequence[AxisNoise], title: str, file: BinaryIO) -> None:
    """Write a PNG of the deviations of `noise_of`: measured with their standard deviations, fitted, and the parts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for place, sensor in zip(figure.subplots(1, 2), NAMES, strict=True):
        for axis in (one for one in axes if one.sensor == sensor and len(one.taus)):
            colour = COLOURS[axis.name[-1]]
            place.errorbar(axis.taus, axis.deviations, axis.stddevs, fmt=".", color=colour, label=axis.name)
            place.plot(axis.taus, axis.fit, color=colour, linewidth=1)
            taus = axis.taus
        numbers, _ = worst(axes, sensor)
        for number, square, what, style in zip(
            numbers, terms(taus).T, NAMES[sensor], ("--", ":", "-."), strict=True
        ):
            if number == number:
                place.plot(taus, number * square**0.5, style, color="grey", label=f"{what}, worst axis")
        place.set(xscale="log", yscale="log", xlabel="cluster time, s")
        place.set_ylabel(f"Allan deviation of the {sensor}, {UNITS[sensor][0][1]}")
        place.grid(True, which="both", alpha=0.3)
        place.legend(fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(file, format="png")
