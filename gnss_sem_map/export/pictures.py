"""Pictures of the map: from above with a legend, and from behind the vehicle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.point_cloud import drawable, visible
from gnss_sem_map.export.raster import NO_VOXELS, NOTHING, TopView, top_view
from gnss_sem_map.export.render import Camera, draw_cubes, hollows, lit
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet
from gnss_sem_map.voxels.semantic_map import SemanticMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST_SIDE_PX = 1800
NARROWEST_PX, LOWEST_PX = 900, 300
"""Least size of the map window, so that the legend fits."""
MARGIN_PX, TITLE_PX, SCALE_BAR_PX = 30, 60, 320
ENTRY_PX = (215, 36)
"""Width and height of one class in the legend."""
DPI = 150
COMPRESS_LEVEL = 4
"""Of zlib: half the time of the usual 6, and files larger by 2 to 4 %."""

PERSPECTIVE_PX = (1920, 1080)
SUPERSAMPLING = 2
FIELD_OF_VIEW_DEG = 62.0
BEHIND_M, ABOVE_M = 13.0, 10.0
"""Vector from the vehicle to the virtual camera."""
AHEAD_M, BELOW_M = 24.0, 2.0
"""Vector from the vehicle to the point on the road ahead that the virtual camera looks at."""
BEAD_M = 0.12
TRACK_COLOUR = (255, 214, 10)
SKY = np.array([[13, 17, 28], [38, 48, 66]], np.float32)
"""RGB at the upper and the lower edge."""
HOLLOWS = np.array([(2, 6.0, 0.1), (8, 2.5, 0.15), (24, 1.5, 0.25), (64, 1.0, 0.35)], np.float32)
"""Pixels to the neighbour, strength, and the largest step in log depth that counts: edges, then wide shadows."""

UNLABELLED_BY_DAY, UNLABELLED_BY_NIGHT = (214, 217, 222), (72, 80, 97)
UNLABELLED_ALONE = (150, 158, 172)
"""Used in a map without labels."""

Colour = NDArray[np.uint8] | tuple[int, int, int]

_MATPLOTLIB = Lock()
"""Its figures may not be drawn by two threads at once."""


def write_topview(
    semantic_map: SemanticMap,
    path: Path | str,
    trajectory: Trajectory | None = None,
    title: str | None = None,
) -> None:
    """Draw the map from above as PNG, coloured by class, with legend, scale bar, north arrow and the track.

    North is up; of every column the highest labelled voxel is seen, light grey where no camera saw any; what is
    high darkens what lies beside it. Small maps get several pixels per voxel, large ones several voxels per pixel.
    Raises DataError for an empty map or when the file cannot be written.
    """
    view = top_view(semantic_map, LONGEST_SIDE_PX)
    label_set = semantic_map.voxels.label_set
    zoom = max(1, LONGEST_SIDE_PX // max(view.labels.shape))
    image = np.repeat(np.repeat(_seen_from_above(view, label_set), zoom, axis=0), zoom, axis=1)
    entries = _legend_entries(view.labels, label_set, _unlabelled(view.labels, UNLABELLED_BY_DAY))
    if trajectory is not None:
        entries.append(("track, from the dot", (0, 0, 0)))
    columns = (max(image.shape[1], NARROWEST_PX) - SCALE_BAR_PX - 100) // ENTRY_PX[0]
    strip_px = 50 + ENTRY_PX[1] * -(-len(entries) // columns)
    with _MATPLOTLIB:
        figure, axes = _frame(view, image, zoom, strip_px)
        strip = _strip(figure, strip_px)
        _draw_entries(strip, entries, columns, "black")
        _draw_scale_and_north(strip, view.cell_m / zoom)
        if trajectory is not None:
            _draw_track(axes, trajectory)
        if title is not None:
            axes.set_title(title, fontsize=11, loc="left", parse_math=False)
        pixels = _drawn(figure)
    _write_png(pixels, path)


def _seen_from_above(view: TopView, label_set: LabelSet) -> NDArray[np.uint8]:
    """(rows, columns, 3) RGB: the class colours, lighter with height, darker beside something higher."""
    # labels -2 (nothing) and -1 (unlabelled) count from the end
    unlabelled = _unlabelled(view.labels, UNLABELLED_BY_DAY)
    palette = np.vstack([label_set.colours, (255, 255, 255), unlabelled]) / 255
    empty = view.labels == NOTHING
    low, high = np.nanpercentile(view.heights, [2, 98])
    lightness = np.clip((view.heights - low) / max(high - low, 1.0), 0, 1)
    shade = (0.85 + 0.2 * lightness) * np.exp(-0.25 * hollows(-view.heights, reach=1, most=3.0))
    image = palette[view.labels] * np.where(empty, 1.0, shade)[..., None]
    return np.asarray(np.rint(255 * np.clip(image, 0, 1)), np.uint8)


def _legend_entries(
    labels: NDArray[np.int8], label_set: LabelSet, unlabelled: Colour
) -> list[tuple[str, Colour]]:
    """Name and colour of the classes among these labels."""
    entries: list[tuple[str, Colour]] = [
        (name, colour)
        for i, (name, colour) in enumerate(zip(label_set.names, label_set.colours, strict=True))
        if (labels == i).any()
    ]
    what = "no camera saw it" if entries else "no labels"
    return entries + [(what, unlabelled)] * bool((labels == UNLABELLED).any())


def _unlabelled(labels: NDArray[np.int8], beside_others: Colour) -> Colour:
    """Colour of unlabelled voxels."""
    return beside_others if (labels >= 0).any() else UNLABELLED_ALONE


def _frame(view: TopView, image: NDArray[np.uint8], zoom: int, strip_px: int) -> tuple[Figure, Any]:
    """A figure whose pixels are the image's, with room for the title above and a strip of `strip_px` below."""
    height, width = image.shape[:2]
    tall, wide = max(height, LOWEST_PX), max(width, NARROWEST_PX)
    full = (wide + 2 * MARGIN_PX, tall + TITLE_PX + strip_px)
    figure = _figure(*full, "white")
    axes = figure.add_axes((MARGIN_PX / full[0], strip_px / full[1], wide / full[0], tall / full[1]))
    pixel_m = view.cell_m / zoom
    east, south = view.west + width * pixel_m, view.north - height * pixel_m
    axes.imshow(image, extent=(view.west, east, south, view.north), interpolation="nearest")
    beside_m, above_m = (wide - width) / 2 * pixel_m, (tall - height) / 2 * pixel_m
    axes.set_xlim(view.west - beside_m, east + beside_m)
    axes.set_ylim(south - above_m, view.north + above_m)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("#b0b0b0")
    return figure, axes


def _draw_track(axes: Any, trajectory: Trajectory) -> None:
    from matplotlib.patheffects import Normal, Stroke

    east, north, _ = trajectory.positions.T
    casing = [Stroke(linewidth=2.0, foreground="white"), Normal()]
    axes.plot(east, north, color="black", linewidth=0.9, path_effects=casing)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    inside = np.flatnonzero((east > left) & (east < right) & (north > low) & (north < high))[:1]
    axes.plot(east[inside], north[inside], "o", color="black", markersize=5, markeredgecolor="white")


def _strip(figure: Figure, strip_px: int) -> Any:
    """Axes over the lowest pixels of a figure, in pixels from their upper left corner."""
    width, height = figure.get_size_inches() * DPI
    strip = figure.add_axes((0, 0, 1, strip_px / height), xlim=(0, width), ylim=(strip_px, 0), frameon=False)
    strip.set(xticks=[], yticks=[])
    return strip


def _draw_entries(strip: Any, entries: list[tuple[str, Colour]], columns: int, text: str) -> None:
    from matplotlib.patches import Rectangle

    for i, (name, colour) in enumerate(entries):
        x, y = MARGIN_PX + ENTRY_PX[0] * (i % columns), 22 + ENTRY_PX[1] * (i // columns)
        strip.add_patch(
            Rectangle((x, y), 22, 22, facecolor=np.divide(colour, 255), edgecolor="#606060", lw=0.5)
        )
        strip.text(x + 32, y + 11, name[:20], va="center", fontsize=8.5, color=text, parse_math=False)


def _draw_scale_and_north(strip: Any, metres_per_px: float) -> None:
    bar_m = _round_length(SCALE_BAR_PX * metres_per_px)
    right = strip.get_xlim()[1] - MARGIN_PX - 60
    left = right - bar_m / metres_per_px
    text = f"{bar_m:g} m" if bar_m < 1000 else f"{bar_m / 1000:g} km"
    strip.plot([left, left, right, right], [34, 44, 44, 34], color="black", linewidth=1.4)
    strip.text((left + right) / 2, 30, text, ha="center", fontsize=8.5)
    strip.annotate(
        "N", xy=(right + 45, 14), xytext=(right + 45, 58), ha="center", va="center", fontsize=9,
        arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 1.4},
    )  # fmt: skip


def _round_length(longest_m: float) -> float:
    """The largest of 1, 2, 5, 10, 20, 50... metres that does not exceed the given length."""
    power = 10.0 ** np.floor(np.log10(longest_m))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest_m))


def write_perspective(
    semantic_map: SemanticMap,
    path: Path | str,
    trajectory: Trajectory | None = None,
    at_s: float | None = None,
    camera: Camera | None = None,
) -> None:
    """Draw the map as PNG, as seen by a virtual camera behind and above the vehicle, with legend and track.

    The vehicle is where it was at the stamp `at_s`, by default where the camera sees most of the map; without a
    trajectory the camera looks at the whole map from the south. Or give a `camera`. Raises DataError for an empty
    map or when the file cannot be written, and MeasurementError when `at_s` lies outside the trajectory.
    """
    kept = drawable(semantic_map)
    if not kept.any():
        raise DataError(NO_VOXELS)
    centres, labels = semantic_map.voxels.centres[kept], semantic_map.labels[kept]
    if camera is None:
        framed, voxel_m = visible(semantic_map)[kept], semantic_map.voxels.voxel_size_m
        if trajectory is None:
            camera = _from_the_south(centres[framed])
        else:
            at_s = _best_stamp(trajectory, centres, framed, voxel_m) if at_s is None else at_s
            camera = _behind(trajectory, at_s)
    track = np.empty((0, 3)) if trajectory is None else _beads(trajectory)
    half_m = np.repeat([semantic_map.voxels.voxel_size_m / 2, BEAD_M / 2], [len(centres), len(track)])
    unlabelled = _unlabelled(labels, UNLABELLED_BY_NIGHT)
    palette = np.vstack([semantic_map.voxels.label_set.colours, unlabelled])  # -1 is the last
    rgb = np.vstack([palette[labels], np.tile(TRACK_COLOUR, (len(track), 1))])
    image = _lit(np.vstack([centres, track]), half_m, rgb, camera)
    entries = _legend_entries(labels, semantic_map.voxels.label_set, unlabelled)
    if trajectory is not None:
        entries.append(("track", TRACK_COLOUR))
    _write_png(np.vstack([image, _legend(image.shape[1], entries)]), path)


def _behind(trajectory: Trajectory, at_s: float) -> Camera:
    """Virtual camera behind and above the vehicle, in driving direction."""
    T_map_imu = trajectory.at([at_s])[0]
    vehicle, forward = T_map_imu[:3, 3], T_map_imu[:3, 0] * (1, 1, 0)
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0])
    return _camera(vehicle - BEHIND_M * forward + ABOVE_M * up, vehicle + AHEAD_M * forward - BELOW_M * up)


def _best_stamp(
    trajectory: Trajectory, centres: NDArray[np.float64], framed: NDArray[np.bool_], voxel_m: float
) -> float:
    """The stamp, of a few candidates before the end of the track, with most voxels in view."""
    along = _along(trajectory)
    stamps = trajectory.stamps[along <= max(0.0, along[-1] - AHEAD_M / 2)]
    stamps = stamps[:: 1 + len(stamps) // 20]
    seen = []
    for at_s in stamps:
        camera = _behind(trajectory, at_s)
        near = np.flatnonzero(np.linalg.norm(centres - camera.target, axis=1) < 2 * (AHEAD_M + BEHIND_M))
        sketch = replace(camera, width_px=camera.width_px // 6, height_px=camera.height_px // 6)
        cubes = draw_cubes(centres[near], np.full(len(near), voxel_m / 2), sketch).cube
        in_view = np.zeros(len(near), np.bool_)
        in_view[cubes[cubes >= 0]] = True
        seen.append(np.count_nonzero(in_view & framed[near]))
    return float(stamps[np.argmax(seen)])


def _from_the_south(centres: NDArray[np.float64]) -> Camera:
    middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
    distance = max(20.0, 0.8 * float(np.ptp(centres[:, :2], axis=0).max()))
    return _camera(middle + distance * np.array([0, -1, 0.6]), middle)


def _camera(eye: NDArray[np.float64], target: NDArray[np.float64]) -> Camera:
    width, height = PERSPECTIVE_PX
    return Camera(eye, target, width, height, FIELD_OF_VIEW_DEG)


def _beads(trajectory: Trajectory) -> NDArray[np.float64]:
    """Points (n, 3) m along the track, dense enough to be drawn as a line."""
    along = _along(trajectory)
    steps = np.arange(0.0, along[-1], BEAD_M / 2)
    return np.column_stack([np.interp(steps, along, axis) for axis in trajectory.positions.T])


def _along(trajectory: Trajectory) -> NDArray[np.float64]:
    """Distance driven up to every pose, (k,) m."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)))


def _lit(
    centres: NDArray[np.float64], half_m: NDArray[np.float64], rgb: NDArray[np.uint8], camera: Camera
) -> NDArray[np.uint8]:
    """(h, w, 3) RGB: shaded cubes with ambient occlusion and distance fog."""
    distance = float(np.linalg.norm(camera.target - camera.eye))
    near = np.linalg.norm(centres - camera.eye, axis=1) < 10 * distance
    colours = np.vstack([rgb[near], [[0, 0, 0]]]).astype(np.float32)  # the sky is cube -1, the last
    fine = replace(
        camera, width_px=SUPERSAMPLING * camera.width_px, height_px=SUPERSAMPLING * camera.height_px
    )
    picture = draw_cubes(centres[near], half_m[near], fine)
    sky = np.linspace(SKY[0], SKY[1], fine.height_px, dtype=np.float32)
    return np.rint(lit(picture, colours, sky, distance, HOLLOWS, SUPERSAMPLING)).astype(np.uint8)


def _legend(width: int, entries: list[tuple[str, Colour]]) -> NDArray[np.uint8]:
    """A dark strip (h, width, 3) with the classes."""
    columns = max(1, (width - 2 * MARGIN_PX) // ENTRY_PX[0])
    strip_px = 28 + ENTRY_PX[1] * -(-len(entries) // columns)
    with _MATPLOTLIB:
        figure = _figure(width, strip_px, SKY[0] / 255)
        _draw_entries(_strip(figure, strip_px), entries, columns, "white")
        return _drawn(figure)


def _figure(width: int, height: int, colour: Any) -> Figure:
    """An empty figure of so many pixels."""
    from matplotlib.figure import Figure

    beyond = 1e-6  # matplotlib truncates: 54.999... would be 54
    return Figure(figsize=((width + beyond) / DPI, (height + beyond) / DPI), dpi=DPI, facecolor=colour)


def _drawn(figure: Figure) -> NDArray[np.uint8]:
    """The pixels of a figure, (h, w, 3) RGB."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def _write_png(pixels: NDArray[np.uint8], path: Path | str) -> None:
    with replacing(path) as file:
        Image.fromarray(pixels).save(file, "png", compress_level=COMPRESS_LEVEL, dpi=(DPI, DPI))
