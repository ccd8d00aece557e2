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
from gnss_sem_map.export.exported import NO_VOXELS, Exported
from gnss_sem_map.export.raster import NOTHING, TopView, top_view
from gnss_sem_map.export.render import Camera, Picture, draw_cubes, hollows, lit
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile

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
SKETCHED_M = 2 * (AHEAD_M + BEHIND_M)
"""How far around its target a camera is judged by what it sees."""
BEAD_M = 0.12
TRACK_COLOUR = (255, 214, 10)
SKY = np.array([[13, 17, 28], [38, 48, 66]], np.float32)
"""RGB at the upper and the lower edge."""
HOLLOWS = np.array([(2, 6.0, 0.1), (8, 2.5, 0.15), (24, 1.5, 0.25), (64, 1.0, 0.35)], np.float32)
"""Pixels to the neighbour in a picture of that size, strength, and the largest step in log depth that counts: edges,
then wide shadows."""

UNLABELLED_BY_DAY, UNLABELLED_BY_NIGHT = (214, 217, 222), (72, 80, 97)
UNLABELLED_ALONE = (150, 158, 172)
"""Used in a map without labels."""
WHITE_OF_INFERRED = 0.35
"""So much white is mixed into the colour of what no camera saw and of which the class is inferred."""

Colour = NDArray[np.uint8 | np.float64] | tuple[int, int, int]

_MATPLOTLIB = Lock()
"""Its figures may not be drawn by two threads at once."""


def write_topview(exported: Exported, path: Path | str) -> None:
    """Draw the map from above as PNG, coloured by class, with legend, scale bar, north arrow and the tracks.

    North is up; of every column the highest labelled voxel is seen, light grey where none has a label; what is inferred
    is lighter, and what is high darkens what lies beside it. Small maps get several pixels per voxel, large ones
    several voxels per pixel. Raises DataError for an empty map or when the file cannot be written.
    """
    view = top_view(exported, LONGEST_SIDE_PX)
    label_set = exported.map.label_set
    zoom = max(1, LONGEST_SIDE_PX // max(view.labels.shape))
    image = np.repeat(np.repeat(_seen_from_above(view, label_set), zoom, axis=0), zoom, axis=1)
    counts = np.bincount(view.labels[view.labels != NOTHING] + 1, minlength=1 + len(label_set.legend.names))
    entries = _legend_entries(np.roll(counts, -1), bool(view.inferred.any()), label_set, UNLABELLED_BY_DAY)
    if exported.tracks:
        entries.append(("track, from the dot", (0, 0, 0)))
    columns = (max(image.shape[1], NARROWEST_PX) - SCALE_BAR_PX - 100) // ENTRY_PX[0]
    strip_px = 50 + ENTRY_PX[1] * -(-len(entries) // columns)
    with _MATPLOTLIB:
        figure, axes, page = _frame(view, image, zoom, strip_px)
        strip = _strip(figure, strip_px)
        _draw_entries(strip, entries, columns, "black")
        _draw_scale_and_north(strip, view.cell_m / zoom)
        for track in exported.tracks:
            _draw_track(axes, track)
        if exported.title is not None:
            axes.set_title(exported.title, fontsize=11, loc="left", parse_math=False)
        pixels = _drawn(figure, page)
    _write_png(pixels, path)


def _seen_from_above(view: TopView, label_set: LabelSet) -> NDArray[np.uint8]:
    """(rows, columns, 3) RGB: the class colours, lighter with height, darker beside something higher."""
    # -2 (nothing) and -1 (unlabelled) count from the end
    unlabelled = UNLABELLED_BY_DAY if (view.labels >= 0).any() else UNLABELLED_ALONE
    palette = np.vstack([_class_colours(label_set), (255, 255, 255), unlabelled]) / 255
    numbers = view.labels + np.int16(len(label_set.legend.names)) * view.inferred
    low, high = np.nanpercentile(view.heights, [2, 98])
    lightness = np.clip((view.heights - low) / max(high - low, 1.0), 0, 1)
    shade = (0.85 + 0.2 * lightness) * np.exp(-0.25 * hollows(-view.heights, reach=1, most=3.0))
    shade[view.labels == NOTHING] = 1.0
    image = np.empty((*view.labels.shape, 3), np.uint8)
    for channel, colours in enumerate(palette.T):  # all at once would take hundreds of MB
        image[..., channel] = np.rint(255 * np.clip(colours[numbers] * shade, 0, 1))
    return image


def _class_colours(label_set: LabelSet) -> NDArray[np.float64]:
    """(2 c + 2, 3) RGB of the classes and `other` as cameras saw them, and then, lighter, inferred."""
    return np.vstack([label_set.legend.colours, _lighter(label_set.legend.colours)])


def _lighter(colours: Colour) -> NDArray[np.float64]:
    return (1 - WHITE_OF_INFERRED) * np.asarray(colours) + WHITE_OF_INFERRED * 255


def _legend_entries(
    counts: NDArray[np.int64], has_inferred: bool, label_set: LabelSet, unlabelled: Colour
) -> list[tuple[str, Colour]]:
    """Name and colour of the classes of which there are any; `counts` (c + 2,), the last of what has no label."""
    legend = label_set.legend
    entries: list[tuple[str, Colour]] = [
        (name, colour)
        for name, colour, count in zip(legend.names, legend.colours, counts[:-1], strict=True)
        if count
    ]
    if has_inferred:
        entries.append(("lighter: inferred", _lighter(entries[0][1])))
    if counts[-1]:
        entries.append(("no class", unlabelled) if entries else ("no labels", UNLABELLED_ALONE))
    return entries


def _frame(
    view: TopView, image: NDArray[np.uint8], zoom: int, strip_px: int
) -> tuple[Figure, Any, NDArray[np.uint8]]:
    """The image on a page, with room for the title above and a strip of `strip_px` below; a figure and axes over it.

    matplotlib draws over the page: its own images would take ten times the memory.
    """
    height, width = image.shape[:2]
    tall, wide = max(height, LOWEST_PX), max(width, NARROWEST_PX)
    full = (wide + 2 * MARGIN_PX, tall + TITLE_PX + strip_px)
    page = np.full((full[1], full[0], 3), 255, np.uint8)
    top, left = TITLE_PX + (tall - height) // 2, MARGIN_PX + (wide - width) // 2
    page[top : top + height, left : left + width] = image
    figure = _figure(*full)
    place = (MARGIN_PX / full[0], strip_px / full[1], wide / full[0], tall / full[1])
    axes = figure.add_axes(place, facecolor="none")
    pixel_m = view.cell_m / zoom
    east, south = view.west + width * pixel_m, view.north - height * pixel_m
    beside_m, above_m = (wide - width) / 2 * pixel_m, (tall - height) / 2 * pixel_m
    axes.set_xlim(view.west - beside_m, east + beside_m)
    axes.set_ylim(south - above_m, view.north + above_m)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("#b0b0b0")
    return figure, axes, page


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


def write_perspective(exported: Exported, path: Path | str, camera: Camera | None = None) -> None:
    """Draw the map as PNG, as seen by a virtual camera behind and above the vehicle, with legend and tracks.

    The vehicle is where the camera sees most of the map; without a track the camera looks at the whole map from the
    south. Or give a `camera`. Raises DataError for an empty map or when the file cannot be written.
    """
    extent, label_set = exported.extent, exported.map.label_set
    if not extent.count:
        raise DataError(NO_VOXELS)
    if camera is None:
        camera = _best_behind(exported) if exported.tracks else _from_the_south(exported)
    colours = colours_by_night(exported)
    image = lit_view(exported, colours, camera)
    entries = _legend_entries(extent.labels, extent.inferred > 0, label_set, colours[-2])
    if exported.tracks:
        entries.append(("track", TRACK_COLOUR))
    _write_png(np.vstack([image, _legend(image.shape[1], entries)]), path)


def colours_by_night(exported: Exported) -> NDArray[np.uint8]:
    """(2 c + 4, 3) RGB before a dark sky: of the classes seen and inferred, of no label, and of the tracks."""
    unlabelled = UNLABELLED_BY_NIGHT if exported.extent.labels[:-1].any() else UNLABELLED_ALONE
    return np.vstack([_class_colours(exported.map.label_set), unlabelled, TRACK_COLOUR]).astype(np.uint8)


def _behind(T_map_imu: NDArray[np.float64]) -> Camera:
    """Virtual camera behind and above the vehicle, in driving direction."""
    vehicle, forward = T_map_imu[:3, 3], T_map_imu[:3, 0] * (1, 1, 0)
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0])
    return _camera(vehicle - BEHIND_M * forward + ABOVE_M * up, vehicle + AHEAD_M * forward - BELOW_M * up)


def _best_behind(exported: Exported) -> Camera:
    """The camera behind the vehicle, of a few before the ends of the tracks, with most voxels in view.

    These are compared in small pictures, in which one column of voxels stands for four.
    """
    voxel_m = exported.map.voxel_size_m
    poses = np.concatenate([_before_the_end(track) for track in exported.tracks])
    cameras = [_behind(pose) for pose in poses[:: 1 + len(poses) // 20]]
    sketches = [replace(each, width_px=each.width_px // 6, height_px=each.height_px // 6) for each in cameras]
    pictures = [Picture.empty(sketch) for sketch in sketches]
    drawn = 0
    for tile in exported.map.tiles:
        near = [i for i, each in enumerate(cameras) if _distance(tile, voxel_m, each.target) < SKETCHED_M]
        if not near:
            continue
        piece = exported.map.read_tile(tile)
        x, y, _ = piece.voxels.indices.T
        chosen = exported.extent.drawable(piece) & ((x | y) % 2 == 0)
        centres, numbers = piece.voxels.centres[chosen], np.arange(drawn, drawn + len(piece), dtype=np.int32)
        numbers[~exported.extent.visible(piece)] = -1  # hides others and does not count
        drawn += len(piece)
        for i in near:
            sketch = sketches[i]
            draw_cubes(pictures[i], sketch, centres, voxel_m, numbers[chosen], sketch.target, SKETCHED_M)
    seen = [len(np.unique(picture.cube[picture.cube >= 0])) for picture in pictures]
    return cameras[int(np.argmax(seen))]


def _before_the_end(track: Trajectory) -> NDArray[np.float64]:
    """The poses (k, 4, 4) from which a camera still looks at what was driven."""
    along = driven_m(track)
    poses: NDArray[np.float64] = track.T_map_imu[along <= max(0.0, along[-1] - AHEAD_M / 2)]
    return poses


def _from_the_south(exported: Exported) -> Camera:
    low, high = (
        (0.5 + edge) * exported.map.voxel_size_m for edge in (exported.extent.low, exported.extent.high)
    )
    middle, distance = (low + high) / 2, max(20.0, 0.8 * float((high - low)[:2].max()))
    return _camera(middle + distance * np.array([0, -1, 0.6]), middle)


def _camera(eye: NDArray[np.float64], target: NDArray[np.float64]) -> Camera:
    width, height = PERSPECTIVE_PX
    return Camera(eye, target, width, height, FIELD_OF_VIEW_DEG)


def _beads(trajectory: Trajectory) -> NDArray[np.float64]:
    """Points (n, 3) m along the track, dense enough to be drawn as a line."""
    along = driven_m(trajectory)
    steps = np.arange(0.0, along[-1], BEAD_M / 2)
    return np.column_stack([np.interp(steps, along, axis) for axis in trajectory.positions.T])


def driven_m(trajectory: Trajectory) -> NDArray[np.float64]:
    """Distance driven up to every pose, (k,) m."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)))


def lit_view(exported: Exported, palette: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """(h, w, 3) RGB: shaded cubes with ambient occlusion and distance fog, nearest tiles first.

    The palette is that of `colours_by_night`.
    """
    distance = float(np.linalg.norm(camera.target - camera.eye))
    fine = replace(
        camera, width_px=SUPERSAMPLING * camera.width_px, height_px=SUPERSAMPLING * camera.height_px
    )
    picture, tiled_map, reach_m = Picture.empty(fine), exported.map, 10 * distance
    unlabelled, track, inferred = len(palette) - 2, len(palette) - 1, len(palette) // 2 - 1
    for driven in exported.tracks:
        beads = _beads(driven)
        draw_cubes(
            picture, fine, beads, BEAD_M / 2, np.full(len(beads), track, np.int32), camera.eye, reach_m
        )
    distances = {tile: _distance(tile, tiled_map.voxel_size_m, camera.eye) for tile in tiled_map.tiles}
    for tile in sorted((tile for tile in distances if distances[tile] < reach_m), key=distances.__getitem__):
        piece = tiled_map.read_tile(tile)
        chosen = exported.extent.drawable(piece)
        numbers = piece.labels + np.int32(inferred) * piece.inferred
        numbers = np.where(piece.labels < 0, unlabelled, numbers)[chosen].astype(np.int32)
        centres, half_m = piece.voxels.centres[chosen], tiled_map.voxel_size_m / 2
        order = _nearest_first(centres, camera.eye, reach_m)
        draw_cubes(picture, fine, centres[order], half_m, numbers[order], camera.eye, reach_m)
    sky = np.linspace(SKY[0], SKY[1], fine.height_px, dtype=np.float32)
    hollow = HOLLOWS.copy()
    hollow[:, 0] = np.maximum(1, hollow[:, 0] * camera.width_px // PERSPECTIVE_PX[0])
    image = lit(picture, palette.astype(np.float32), sky, distance, hollow, SUPERSAMPLING)
    return np.rint(image).astype(np.uint8)


def _nearest_first(
    centres: NDArray[np.float64], eye: NDArray[np.float64], reach_m: float
) -> NDArray[np.int64]:
    """The order by distance from the eye, to some thousandths of the reach: what is hidden then costs little."""
    squares = sum(((axis - at) / reach_m) ** 2 for axis, at in zip(centres.T, eye, strict=True))
    return np.argsort(np.minimum(4000 * np.sqrt(squares), 4001).astype(np.int16), kind="stable")


def _distance(tile: Tile, voxel_m: float, point: NDArray[np.float64]) -> float:
    """Horizontal distance of a point from a tile, m; 0 inside."""
    low = np.array(tile) * (voxel_m * (1 << TILE_BITS))
    outside = np.maximum(low - point[:2], point[:2] - (low + voxel_m * (1 << TILE_BITS)))
    return float(np.linalg.norm(np.maximum(outside, 0)))


def _legend(width: int, entries: list[tuple[str, Colour]]) -> NDArray[np.uint8]:
    """A dark strip (h, width, 3) with the classes."""
    columns = max(1, (width - 2 * MARGIN_PX) // ENTRY_PX[0])
    strip_px = 28 + ENTRY_PX[1] * -(-len(entries) // columns)
    with _MATPLOTLIB:
        figure = _figure(width, strip_px)
        _draw_entries(_strip(figure, strip_px), entries, columns, "white")
        return _drawn(figure, np.tile(SKY[0].astype(np.uint8), (strip_px, width, 1)))


def _figure(width: int, height: int) -> Figure:
    """An empty figure of so many pixels, without background."""
    from matplotlib.figure import Figure

    beyond = 1e-6  # matplotlib truncates: 54.999... would be 54
    return Figure(figsize=((width + beyond) / DPI, (height + beyond) / DPI), dpi=DPI, facecolor="none")


def _drawn(figure: Figure, page: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The pixels of a page (h, w, 3) RGB with a figure drawn over them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    pixels = np.asarray(renderer.buffer_rgba())
    pixels[..., :3], pixels[..., 3] = page, 255
    figure.draw(renderer)
    return pixels[..., :3]


def _write_png(pixels: NDArray[np.uint8], path: Path | str) -> None:
    with replacing(path) as file:
        Image.fromarray(pixels).save(file, "png", compress_level=COMPRESS_LEVEL, dpi=(DPI, DPI))
