"""Pictures of the map: from above with a legend, and from behind the vehicle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.atomic import replacing
from gnss_sem_map.export.point_cloud import UNLABELLED_COLOUR
from gnss_sem_map.export.raster import NOTHING, TopView, top_view
from gnss_sem_map.labels import UNLABELLED, LabelSet
from gnss_sem_map.voxel_map import SemanticMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST_SIDE_PX = 1800
NARROWEST_PX, LOWEST_PX = 900, 300
"""The map's window is at least this large, so that the legend has room."""
MARGIN_PX, TITLE_PX, SCALE_BAR_PX = 30, 60, 320
ENTRY_PX = (200, 36)
"""Width and height of one class in the legend."""
DPI = 150

Colour = NDArray[np.uint8] | tuple[int, int, int]


def write_topview(
    semantic_map: SemanticMap,
    path: Path | str,
    trajectory: Trajectory | None = None,
    title: str | None = None,
) -> None:
    """Draw the map from above as PNG, coloured by class, with legend, scale bar, north arrow and the track.

    North is up; the highest voxel wins; walls darken what stands beside them. Small maps get several pixels per
    voxel, large ones several voxels per pixel. Raises DataError for an empty map or when the file cannot be written.
    """
    view = top_view(semantic_map, LONGEST_SIDE_PX)
    label_set = semantic_map.voxels.label_set
    zoom = max(1, LONGEST_SIDE_PX // max(view.labels.shape))
    image = np.repeat(np.repeat(_seen_from_above(view, label_set), zoom, axis=0), zoom, axis=1)
    entries = _legend_entries(view, label_set)
    if trajectory is not None:
        entries.append(("track, from the dot", (0, 0, 0)))
    strip_px = 50 + ENTRY_PX[1] * -(-len(entries) // _legend_columns(max(image.shape[1], NARROWEST_PX)))
    figure, axes = _frame(view, image, zoom, strip_px)
    _draw_legend(figure, axes, entries, strip_px)
    if trajectory is not None:
        _draw_track(axes, trajectory)
    if title is not None:
        axes.set_title(title, fontsize=11, loc="left")
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=DPI)


def _seen_from_above(view: TopView, label_set: LabelSet) -> NDArray[np.uint8]:
    """(rows, columns, 3) RGB: the class colours, lighter with height, darker beside something higher."""
    palette = (
        np.vstack([label_set.colours, [[255, 255, 255]], [UNLABELLED_COLOUR]]) / 255
    )  # -2, -1 count from the end
    empty = view.labels == NOTHING
    low, high = np.nanpercentile(view.heights, [2, 98])
    lightness = np.clip((view.heights - low) / max(high - low, 1.0), 0, 1)
    shade = (0.85 + 0.2 * lightness) * np.exp(-0.25 * hollows(-view.heights, reach=1, most=3.0))
    image = palette[view.labels] * np.where(empty, 1.0, shade)[..., None]
    return np.asarray(np.rint(255 * np.clip(image, 0, 1)), np.uint8)


def _legend_entries(view: TopView, label_set: LabelSet) -> list[tuple[str, Colour]]:
    """Name and colour of what the picture shows."""
    present = [i for i in range(len(label_set.names)) if (view.labels == i).any()]
    entries: list[tuple[str, Colour]] = [(label_set.names[i], label_set.colours[i]) for i in present]
    if (view.labels == UNLABELLED).any():
        entries.append(("unlabelled", UNLABELLED_COLOUR))
    return entries


def hollows(depth: NDArray[np.floating[Any]], reach: int, most: float) -> NDArray[np.float32]:
    """How much nearer to the eye the four neighbours at `reach` pixels are, on average: what eye-dome lighting darkens.

    `depth` (h, w), NaN where nothing is; each difference counts from 0 to `most`. Boucheny, "Visualisation
    scientifique de grands volumes de données" (2009), simplified to one ring of four.
    """
    padded = np.pad(np.asarray(depth, np.float32), reach, mode="edge")
    height, width = depth.shape
    total = np.zeros(depth.shape, np.float32)
    for down, right in ((0, reach), (2 * reach, reach), (reach, 0), (reach, 2 * reach)):
        nearer = depth - padded[down : down + height, right : right + width]
        total += np.clip(np.nan_to_num(nearer, nan=0.0), 0, most)
    return np.asarray(total / 4, np.float32)


def _frame(view: TopView, image: NDArray[np.uint8], zoom: int, strip_px: int) -> tuple[Figure, Any]:
    """A figure whose pixels are the image's, with room for the title above and a strip of `strip_px` below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = image.shape[:2]
    tall, wide = max(height, LOWEST_PX), max(width, NARROWEST_PX)
    full = np.array([wide + 2 * MARGIN_PX, tall + TITLE_PX + strip_px])
    figure = Figure(figsize=tuple(full / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((MARGIN_PX / full[0], strip_px / full[1], wide / full[0], tall / full[1]))
    east, south = view.west + width * view.cell_m / zoom, view.north - height * view.cell_m / zoom
    axes.imshow(image, extent=(view.west, east, south, view.north), interpolation="nearest")
    beside, above = ((wide - width) / 2, (tall - height) / 2)
    axes.set_xlim(view.west - beside * view.cell_m / zoom, east + beside * view.cell_m / zoom)
    axes.set_ylim(south - above * view.cell_m / zoom, view.north + above * view.cell_m / zoom)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("#b0b0b0")
    return figure, axes


def _draw_track(axes: Any, trajectory: Trajectory) -> None:
    from matplotlib.patheffects import Normal, Stroke

    east, north, _ = trajectory.positions.T
    casing = [Stroke(linewidth=2.0, foreground="white"), Normal()]
    axes.plot(east, north, color="black", linewidth=0.9, path_effects=casing)
    axes.plot(east[:1], north[:1], "o", color="black", markersize=5, markeredgecolor="white")


def _draw_legend(figure: Figure, axes: Any, entries: list[tuple[str, Colour]], strip_px: int) -> None:
    """The strip below the map, in pixels from its upper left corner: classes, scale bar, north arrow."""
    from matplotlib.patches import Rectangle

    width, height = figure.get_size_inches() * DPI
    strip = figure.add_axes((0, 0, 1, strip_px / height), xlim=(0, width), ylim=(strip_px, 0), frameon=False)
    strip.set(xticks=[], yticks=[])
    columns = _legend_columns(width - 2 * MARGIN_PX)
    for i, (name, colour) in enumerate(entries):
        x, y = MARGIN_PX + ENTRY_PX[0] * (i % columns), 22 + ENTRY_PX[1] * (i // columns)
        strip.add_patch(
            Rectangle((x, y), 22, 22, facecolor=np.divide(colour, 255), edgecolor="#606060", lw=0.5)
        )
        strip.text(x + 32, y + 11, name[:20], va="center", fontsize=8.5)
    metres_per_px = np.ptp(axes.get_xlim()) / (width - 2 * MARGIN_PX)
    bar_m = _round_length(SCALE_BAR_PX * metres_per_px)
    right = width - MARGIN_PX - 60
    left = right - bar_m / metres_per_px
    strip.plot([left, left, right, right], [34, 44, 44, 34], color="black", linewidth=1.4)
    strip.text(
        (left + right) / 2,
        30,
        f"{bar_m:g} m" if bar_m < 1000 else f"{bar_m / 1000:g} km",
        ha="center",
        fontsize=8.5,
    )
    strip.annotate("N", xy=(right + 45, 14), xytext=(right + 45, 58), ha="center", va="center", fontsize=9,
                   arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 1.4})  # fmt: skip


def _legend_columns(width_px: float) -> int:
    return max(1, int((width_px - SCALE_BAR_PX - 100) // ENTRY_PX[0]))


def _round_length(longest_m: float) -> float:
    """The longest of 1, 2, 5, 10, 20, 50... metres that is not longer than this."""
    power = 10.0 ** np.floor(np.log10(longest_m))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest_m))
