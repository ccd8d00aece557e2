"""Report of a run on one HTML page: a verdict in words, pictures, and folded below it all that is known of the run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from gnss_sem_map.evaluation.metrics import LOOKS
from gnss_sem_map.export.charts import Chart, Curve, chart
from gnss_sem_map.export.dates import date_of
from gnss_sem_map.export.movers import read_movers
from gnss_sem_map.export.overview import NO_LABEL, Overview, coverage_pixels, label_pixels, overview_of
from gnss_sem_map.export.page import page, percent, png
from gnss_sem_map.export.run_files import listed
from gnss_sem_map.export.track import Track, read_track
from gnss_sem_map.export.verdict import verdict_of
from gnss_sem_map.files.ownership import amend
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_file, read_text
from gnss_sem_map.voxels import tiles

PICTURES = {
    "perspective.png": "The map, every voxel a cube, seen from behind and above the vehicle.",
    "topview.png": "The map from above, north up.",
    "trajectory.png": "The trajectory and its GNSS fixes.",
}
MANY_SKIPS = 200
"""Number of skips on the page; run.json lists all."""
ENOUGH_POINTS = 200
"""Of a bin of a reliability curve: the share of fewer is chance."""
MANY_MOVERS = 40
"""Number of moving objects on the page, those of most points first."""
TITLES = {"accuracy": "accuracy", "iou": "IoU"}
LIGHTER = " Lighter: no camera saw it, its class is inferred."
POINTS = "surveyed_points"
MAPS = {"map": "before refinement", "refined": "after refinement"}


def write_report(folder: Path | str, run: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
    """Write `report.html` into a run folder: one self-contained page, its pictures embedded.

    `run` and `metrics` are the contents of run.json and metrics.json; maps and trajectories are read from the folder. A
    section appears only when its data exist; what the verdict does not know it says. Raises DataError when the file
    cannot be written or a map is damaged, and MeasurementError for a damaged trajectory.
    """
    folder = Path(folder)
    title = f"Semantic map of {run.get('name', folder.name)}"
    overviews, tracks = _overviews(folder), _tracks(folder, run)
    refined = overviews.get("refined")
    about_map = run.get("map", {})
    refinement = about_map.get("refinement", {})
    moved = read_movers(folder)
    content = {
        "title": title,
        "facts": _facts(run),
        "verdict": verdict_of(run, metrics, refined, list(tracks.values())),
        "pictures": {name: _picture(folder / name) for name in PICTURES},
        "captions": _captions(refined),
        "overviews": list(_coarse_pictures(overviews)),
        "legend": [] if refined is None else list(_legend(refined)),
        "warnings": [str(warning) for warning in run.get("warnings", ())],
        "map_figures": {key: about_map[key] for key in ("voxels", "points", "points_removed") if key in about_map},
        "calibration": _shares(metrics.get("calibration", {})),
        "looks": [] if refined is None else list(_looks(refined)),
        "origins": {} if refined is None else {f"voxels {name}": percent(x) for name, x in refined.origins.items()},
        "kept": None if refined is None else _kept(refined),
        "reliability": _reliability(metrics.get("calibration", {})),
        "dynamic": _shares(metrics.get("dynamic", {})),
        "path": _path(tracks, moved),
        "band": _band(tracks),
        "trajectory": {name: x for name, x in (run.get("trajectory") or {}).items() if name != POINTS},
        "points": [tuple(point.values()) for point in (run.get("trajectory") or {}).get(POINTS, ())],
        "trajectory_scores": _with_percentages(metrics.get("trajectory", {})),
        "findings": run.get("preflight", {}).get("findings", ()),
        "counts": run.get("counts", {}),
        "files": list(listed(folder)),
        "settings": read_text(folder / "config.yaml") if is_file(folder / "config.yaml") else "",
        "versions": run.get("versions", {}),
    }  # fmt: skip
    for part in (_drives(run), _classes(about_map, metrics.get("semantics", {}), refined),
                 _movers(refinement, moved, "drives" in run),
                 _passed(run), _left_out(run.get("skips", {})), _refined(about_map),
                 _sharpness(metrics.get("sharpness", {})), _stages(run)):  # fmt: skip
        content |= part
    amend(folder, "report.html", page("report.html.j2", **content))


def _overviews(folder: Path) -> dict[str, Overview]:
    """Of the maps before and after refinement, as far as the folder has them."""
    found = {
        name: overview_of(tiles.open_map(folder / name, with_sums=False))
        for name in MAPS
        if is_file(folder / name / "map.json")
    }
    return {name: overview for name, overview in found.items() if overview is not None}


def _tracks(folder: Path, run: Mapping[str, Any]) -> dict[str, Track]:
    """Of every drive of the map, by name, the part with scans; empty where the folder has none."""
    parts = {name: folder / "drives" / name for name in run.get("drives", {})}
    found = {}
    for name, part in (parts or {str(run.get("name", folder.name)): folder}).items():
        if is_file(path := part / "trajectory.parquet"):
            about = read_run(part) if parts else run
            found[name] = read_track(path, about.get("scans_s"))
    return found


def _facts(run: Mapping[str, Any]) -> list[str]:
    facts = []
    if (began := _beginning(run)) is not None:
        facts.append(f"{began:%d %B %Y, %H:%M:%S} UTC")
    origin = run.get("local_frame")
    if origin:
        facts.append(
            f"origin {origin['lat_deg']:.6f}°, {origin['lon_deg']:.6f}°, {origin['alt_m']:.1f} m (WGS 84)"
        )
    else:
        facts.append("not georeferenced")
    if delivery := run.get("delivery"):
        facts.append(f"files in {delivery['crs']} (EPSG:{delivery['epsg']}), heights {delivery['heights']}")
    return facts


def _beginning(run: Mapping[str, Any]) -> datetime | None:
    """The time of the first scan; None where the stamps of the drive are no dates."""
    first_s, _ = run.get("scans_s") or (0.0, 0.0)
    return date_of(run.get("epoch_ns") or 0, first_s)


def _picture(path: Path) -> str:
    return png(path.read_bytes()) if is_file(path) else ""


def _captions(refined: Overview | None) -> dict[str, str]:
    """Of the pictures; of those of the map they say what lighter means where some of it is."""
    if refined is None or not refined.origins["inferred"]:
        return PICTURES
    return {name: text + LIGHTER * (name != "trajectory.png") for name, text in PICTURES.items()}


def _coarse_pictures(overviews: Mapping[str, Overview]) -> Iterator[tuple[str, str]]:
    """Source and caption of the coverage and of the classes before and after refinement."""
    if overviews:
        coverage = png(coverage_pixels(list(overviews.values())[-1]))
        yield coverage, "Coverage: the darker, the more laser points; white: not seen. North is up."
    for name, overview in overviews.items():
        yield png(label_pixels(overview)), f"Classes from above, {MAPS[name]}."


def _legend(overview: Overview) -> Iterator[tuple[str, str]]:
    """Name and colour, as CSS has it, of what is in the pictures of classes."""
    yield from overview.colours.items()
    if (overview.labels == -1).any():
        yield "no class", "#" + bytes(NO_LABEL).hex()


def _looks(overview: Overview) -> Iterator[tuple[str, int, str | None]]:
    """Rows of the confidence by LiDAR points of a voxel."""
    for low, (voxels, mean) in overview.by_looks.items():
        if voxels:
            yield _group(low), voxels, percent(mean)


def _group(low: int) -> str:
    """The group of `LOOKS` with this lower end, in words."""
    end = next((each - 1 for each in LOOKS if each > low), None)
    return f"{low} and more" if end is None else f"{low}" if end == low else f"{low} to {end}"


def _kept(refined: Overview) -> Chart | None:
    """How sure the labels are that are left when less sure ones are cut; None for a map without labels."""
    if not refined.kept:
        return None
    curves: list[Curve] = [
        (name, css, x, y) for css, (name, (x, y)) in zip("ba", refined.kept.items(), strict=False)
    ]
    lowest = min(float(y.min()) for _, y in refined.kept.values())
    return chart(
        "What a least confidence of 0, 0.05, ... 0.95 (from right to left) leaves: the share of the LiDAR points that"
        " keep a label, and the expected accuracy of these, which is their mean confidence.",
        "share with a label", "expected accuracy", curves, (0, 1), (min(0.9, int(10 * lowest) / 10), 1), width=420,
        height=340, has_legend=True,
    )  # fmt: skip


def _reliability(calibration: Mapping[str, Any]) -> Chart | None:
    """Share of right labels over stated confidence, of all and by the looks at a voxel; None without truth."""
    if not calibration.get("bins"):
        return None
    curves: list[Curve] = [("both agree", "c", (0, 1), (0, 1))]
    for low, group in calibration.get("by_looks", {}).items():
        enough = [each for each in group["bins"] if each["points"] >= ENOUGH_POINTS]
        if int(low) in LOOKS and enough:
            curves.append((_group(int(low)), f"g{LOOKS.index(int(low))}", *_confidence_and_right(enough)))
    enough = [each for each in calibration["bins"] if each["points"] >= ENOUGH_POINTS]
    curves.append(("all", "b", *_confidence_and_right(enough)))
    return chart(
        "How often labels of a stated confidence are right, measured against truth, by the LiDAR points of the voxel.",
        "stated confidence", "share that is right", curves, (0, 1), (0, 1), width=420, height=340, has_legend=True,
    )  # fmt: skip


def _confidence_and_right(bins: Sequence[Mapping[str, float]]) -> tuple[list[float], list[float]]:
    return [each["confidence"] for each in bins], [each["right"] for each in bins]


def _path(tracks: Mapping[str, Track], moved: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Where the drives went, and where what moved went."""
    if not tracks:
        return None
    movers = [np.array([(place["east_m"], place["north_m"]) for place in one["track"]]) for one in moved]
    curves: list[Curve] = [("moving object", "b", way[:, 0], way[:, 1]) for way in movers]
    curves += [(name, "a", track.positions[:, 0], track.positions[:, 1]) for name, track in tracks.items()]
    beside = "; orange: what moved" if movers else ""
    return chart(f"The way of the vehicle (blue), north up{beside}.", "east, m", "north, m", curves,
                 height=420, is_equal=True)  # fmt: skip


def _band(tracks: Mapping[str, Track]) -> Chart | None:
    """How uncertain positions are over time, as the smoother states."""
    curves: list[Curve] = []
    for name, track in tracks.items():
        since = track.stamps - track.stamps[0]
        radii = (("horizontal", "a", track.horizontal_95_m), ("height", "b", track.vertical_95_m))
        curves += [
            (f"{name}, {what}", css, since, values) for what, css, values in radii if values is not None
        ]
    if not curves:
        return None
    highest = max(float(np.max(y)) for _, _, _, y in curves)
    return chart("Uncertainty of the position that is not exceeded with 95 % probability, as estimated: horizontal"
                 " (blue) and height (orange).", "time, s", "m", curves, y_range=(0, 1.1 * highest or 1.0))  # fmt: skip


def _drives(run: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of the drives of the map, each with its own report; and why others are not in it."""
    drives: Mapping[str, Mapping[str, Any]] = run.get("drives", {})
    return {
        "drive_keys": list(next(iter(drives.values()), {})),
        "drives": [(name, f"drives/{quote(name)}/report.html", about) for name, about in drives.items()],
        "failed": list(run.get("failed", {}).items()),
    }


def _classes(
    about_map: Mapping[str, Any], semantics: Mapping[str, Any], refined: Overview | None
) -> dict[str, Any]:
    """Table of voxels, accuracy, IoU and confidence per class, before and after refinement, as far as known."""
    counts = about_map.get("labelled", {})
    names = list(dict.fromkeys(n for s in ("raw", "refined") for n in _class_names(counts, semantics, s)))
    columns: list[tuple[str, list[Any]]] = []
    for stage in ("raw", "refined"):
        if stage in counts:
            columns.append(
                (f"voxels, {stage}", [*map(counts[stage].get, names), sum(counts[stage].values())])
            )
    for stage, scores in semantics.items():
        for key in TITLES:
            each = [(scores.get("classes", {}).get(name) or {}).get(key) for name in names]
            columns.append(
                (f"{TITLES[key]}, {stage}", [*map(percent, each), percent(scores.get(f"mean_{key}"))])
            )
    if columns and refined is not None:
        means = (refined.confidence.get(name, (0, 0.0)) for name in names)
        stated = [percent(mean) if voxels else None for voxels, mean in means]
        columns.append(("mean stated confidence", [*stated, None]))
    remarks = {}
    for stage, scores in semantics.items():
        strict = scores.get("strict", {}).get("mean_iou")
        remarks[f"points of the classes of the map that the {stage} map labels"] = percent(
            scores.get("coverage")
        )
        remarks[f"mean IoU, {stage}, if an unlabelled point is a miss"] = percent(strict)
    rows = [(name, *(values[i] for _, values in columns)) for i, name in enumerate([*names, "all"])]
    return {
        "class_head": ("class", *(title for title, _ in columns)),
        "class_rows": rows if columns else [],
        "class_remarks": remarks,
    }


def _class_names(counts: Mapping[str, Any], semantics: Mapping[str, Any], stage: str) -> list[str]:
    return [*counts.get(stage, {}), *semantics.get(stage, {}).get("classes", {})]


def _movers(
    refinement: Mapping[str, Any], moved: Sequence[Mapping[str, Any]], is_of_many: bool
) -> dict[str, Any]:
    """What was tracked, counted; and what moved, with its speed and the evidence."""
    tracked = refinement.get("tracked", ())
    motions = [str(thing["motion"]) for thing in tracked]
    rows = sorted(moved, key=lambda one: -one["points"])[:MANY_MOVERS]
    return {
        "mover_head": "drive, object" if is_of_many else "object",
        "movers": {f"tracked objects, {motion}": motions.count(motion) for motion in sorted(set(motions))},
        "mover_rows": [
            (f"{one['drive']}, {one['id']}" if is_of_many else str(one["id"]),
             f"{one['class']}, by its {one['class_from']}",
             f"{one['speed_mps']:.1f}\u00a0±\u00a0{one['speed_stddev_mps']:.1f}", f"{one['way_m']:.0f}",
             "\u00a0x\u00a0".join(f"{one[side]:.1f}" for side in ("length_m", "width_m", "height_m")),
             *(f"{round(one[end], 1) + 0.0:.1f}" for end in ("first_stamp_s", "last_stamp_s")),
             f"{one['motion']}: {one['evidence']}", one["points"])
            for one in rows
        ],
    }  # fmt: skip


def _passed(run: Mapping[str, Any]) -> dict[str, Any]:
    """How far the surfaces of two passes lay from each other, and lie now; and what stands in one drive only."""
    return {
        "passes": [
            (row["first"], row["second"], row["places"], row["bound"],
             f"{100 * row['before_m']:.1f}", f"{100 * row['after_m']:.1f}")
            for row in run.get("passes", ())
        ],
        "changes": [
            (row["change"], row["class"], row["kind"], f"{row['before']} and {row['after']}",
             ",\u00a0".join(f"{axis:.1f}" for axis in row["centre_m"]),
             "\u00a0x\u00a0".join(f"{axis:.1f}" for axis in row["size_m"]),
             row["voxels"], f"{row['seen_through']:g}")
            for row in run.get("changes", ())
        ],
    }  # fmt: skip


def _left_out(skips: Mapping[str, Any]) -> dict[str, Any]:
    listed = skips.get("listed", ())
    rows = [(skip["what"], skip["where"], skip["reason"]) for skip in listed[:MANY_SKIPS]]
    return {"skips": rows, "more_skips": skips.get("count", len(listed)) - len(rows) if rows else 0}


def _refined(about_map: Mapping[str, Any]) -> dict[str, Any]:
    """Steps of the refinement, and how many vehicles it found to stand or move."""
    refinement = about_map.get("refinement", {})
    motions = [str(thing.get("motion")) for thing in refinement.get("objects", ())]
    figures: dict[str, Any] = {
        f"vehicles, {motion}": motions.count(motion) for motion in sorted(set(motions))
    }
    if "systematic_errors" in refinement and any(about_map.get("labelled", {}).get("raw", {}).values()):
        share = percent(refinement["systematic_errors"])
        figures["systematic label error rate, estimated without truth"] = share
    steps = [
        (
            step["name"],
            step.get("voxels_changed"),
            "; ".join(f"{change}: {count:,}" for change, count in step.get("changes", {}).items())
            or step.get("skipped", ""),
        )
        for step in refinement.get("steps", ())
    ]
    return {"steps": steps, "refinement": figures}


def _sharpness(sharpness: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Surface thickness of the map, and of a map from GNSS and IMU alone: a wrong calibration blurs surfaces."""
    figures = list(dict.fromkeys(name for values in sharpness.values() for name in values))
    rows = [
        (name.replace("_", " "), *(values.get(name) for values in sharpness.values())) for name in figures
    ]
    return {"sharpness_head": ("figure", *sharpness), "sharpness": rows}


def _stages(run: Mapping[str, Any]) -> dict[str, Any]:
    seconds, memory_mb = run.get("seconds", {}), run.get("peak_memory_mb", {})
    longest = max(seconds.values(), default=0) or 1
    return {
        "stages": [(stage, value, memory_mb.get(stage), value / longest) for stage, value in seconds.items()]
    }


def _with_percentages(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Scores of a trajectory with its fractions as percentages."""
    return {
        name: f"{100 * value:.3g} %" if "inside" in name or name.endswith("_share") else value
        for name, value in scores.items()
    }


def _shares(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same metrics with fractions as percentages, without tables."""
    return {
        key: percent(value) if isinstance(value, float) else value
        for key, value in values.items()
        if not isinstance(value, list)
    }
