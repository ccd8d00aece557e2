"""Report of a run on one HTML page: inputs, skips with reasons, quality of the result, and a list of the files."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from gnss_sem_map.export.formats import FORMATS
from gnss_sem_map.files.ownership import amend

PICTURES = {
    "perspective.png": "The map, every voxel a cube, seen from behind and above the vehicle.",
    "topview.png": "The map from above, north up.",
    "trajectory.png": "The trajectory and its GNSS fixes.",
}
FILES = {
    **{each.file: each.what for each in FORMATS},
    "viewer": "the finer voxels of viewer.html, where the map is too large for one page",
    "trajectory.png": PICTURES["trajectory.png"],
    "trajectory.parquet": "poses of the IMU in the map, velocities and covariances",
    "trajectory_alone.parquet": "the same before places that were passed again bound them",
    "trajectory.tum": "the poses as stamp, position and quaternion, for evo",
    "trajectory_covariance.tum": "the same with the covariance of every pose, for smfeval",
    "trajectory_kitti.txt": "the poses as 3 x 4 matrices, for KITTI tools",
    "trajectory.geojson": "the track in WGS 84, for web maps and QGIS",
    "trajectory_wgs84.parquet": "the track in WGS 84 with time, speed and standard deviations, as GeoParquet",
    "map": "the map before refinement, with all evidence, as Parquet tiles",
    "refined": "the refined map as Parquet tiles",
    "drives": "map, evidence, trajectory and report of each of several drives",
    "changes.geojson": "what changed between drives, as boxes in WGS 84, for web maps and QGIS",
    "changes.laz": "the voxels of what changed, as map.laz; user_data 1: appeared, 2: vanished",
    "evidence": "what else the run knows, so that `gnss-sem-map refine` needs no scans",
    "labels": "the class of every LiDAR point, SemanticKITTI raw ids, one file per scan",
    "labels_raw": "the same before refinement",
    "confidence": "the probability of each of these labels, float16",
    "removed": "1 for every LiDAR point on a moving vehicle that was taken out of the map",
    "config.yaml": "all settings of this run",
    "run.json": "the content of this page about the run, machine-readable",
    "metrics.json": "the content of this page about the evaluation, machine-readable",
}
WORDS = {
    "SA": "static points kept (SA)",
    "DA": "points on moving vehicles removed (DA)",
    "AA": "both, geometric mean (AA)",
    "SA_vehicle": "points on parked vehicles kept",
    "ece": "expected calibration error (ECE)",
    "ate_m": "absolute trajectory error (m)",
    "chi2_per_dof": "squared residuals divided by their variances (chi2 per degree of freedom)",
    "position_nees_per_dof": "squared position error / claimed variance (NEES per degree of freedom)",
    "orientation_nees_per_dof": "squared orientation error / claimed variance (NEES per degree of freedom)",
    **{
        f"{part}_inside_{share}": f"{part}: errors inside the ellipsoid that should hold {share} %"
        for part in ("position", "horizontal")
        for share in (50, 90, 95)
    },
    "position_scale_gap": "position: scale gap k, above 1 the variances are too small",
    "horizontal_scale_gap": "horizontal: scale gap k, above 1 the variances are too small",
}
UNITS = {"m": "m", "s": "s", "deg": "°", "mb": "MB", "ns": "ns", "px": "px"}
BAR_PX = 260
MANY_SKIPS = 200
"""Number of skips on the page; run.json lists all."""


def write_report(folder: Path | str, run: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
    """Write `report.html` into a run folder: one self-contained page, its pictures embedded.

    `run` and `metrics` are the contents of run.json and metrics.json; a section appears only when its data, or its
    picture in the folder, exist. Raises DataError when the file cannot be written.
    """
    folder = Path(folder)
    title = f"Semantic map of {run.get('name', folder.name)}"
    sections = [
        f"<h1>{escape(title)}</h1>",
        _facts(run),
        _picture(folder, "perspective.png"),
        _warnings(run.get("warnings", ())),
        _section("Drives", _drives(run.get("drives", {}), run.get("failed", {}))),
        _section("Places passed again", _passes(run.get("passes", ()))),
        _section("What changed", _changes(run.get("changes", ()))),
        _section("Pre-flight", findings_table(run.get("preflight", {}).get("findings", ()))),
        _section("What went in", _pairs(run.get("counts", {}))),
        _section("What was left out", _skips(run.get("skips", {}))),
        _section(
            "Map", _picture(folder, "topview.png"), _classes(run.get("map", {}), metrics.get("semantics", {}))
        ),
        _section("Refinement", _refinement(run.get("map", {}).get("refinement", {}))),
        _section("Moving vehicles", _pairs(_shares(metrics.get("dynamic", {})))),
        _section("Confidence", _pairs(_shares(metrics.get("calibration", {})))),
        _section(
            "Trajectory",
            _picture(folder, "trajectory.png"),
            _pairs(run.get("trajectory") or {}),
            _pairs(metrics.get("trajectory", {})),
        ),
        _section("Sharpness", _sharpness(metrics.get("sharpness", {}))),
        _section("Time and memory", _stages(run.get("seconds", {}), run.get("peak_memory_mb", {}))),
        _section("Files", _files(folder)),
        _section("Versions", _pairs(run.get("versions", {}))),
    ]
    amend(folder, "report.html", page_of(title, sections))


def findings_table(findings: Iterable[Mapping[str, str]]) -> str:
    """The findings of a pre-flight as a table, each row coloured by its level."""
    rows = "".join(
        f'<tr class="{escape(found["level"])}">{_cell(found["level"])}{_cell(found["check"])}{_cell(found["evidence"])}'
        f"{_cell(found['mistake'])}{_cell(found['remedy'])}</tr>"
        for found in findings
    )
    titles = "".join(
        f"<th>{title}</th>" for title in ("", "check", "found", "probable mistake", "what to do")
    )
    return f'<div class="scroll"><table><tr>{titles}</tr>{rows}</table></div>' if rows else ""


def page_of(title: str, sections: Iterable[str]) -> bytes:
    """One self-contained page of HTML sections."""
    template = (resources.files("gnss_sem_map.export") / "assets" / "report.html").read_text("utf-8")
    page = Template(template).substitute(title=escape(title), body="\n".join(filter(None, sections)))
    return page.encode("utf-8", "backslashreplace")


def _section(title: str, *parts: str) -> str:
    content = "\n".join(filter(None, parts))
    return f"<section><h2>{escape(title)}</h2>\n{content}</section>" if content else ""


def _sharpness(sharpness: Mapping[str, Mapping[str, Any]]) -> str:
    """Surface thickness of the map, and of a map from GNSS and IMU alone: a wrong calibration blurs surfaces."""
    if not sharpness:
        return ""
    figures = list(dict.fromkeys(name for values in sharpness.values() for name in values))
    rows = [(name.replace("_", " "), *(_number(v.get(name)) for v in sharpness.values())) for name in figures]
    return _table(("figure", *sharpness), rows)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.4g}" if isinstance(value, float) else f"{value:,}"


def _facts(run: Mapping[str, Any]) -> str:
    facts = []
    if run.get("epoch_ns") is not None:
        facts.append(f"{datetime.fromtimestamp(run['epoch_ns'] / 1e9, UTC):%d %B %Y, %H:%M:%S} UTC")
    origin = run.get("local_frame")
    if origin:
        facts.append(
            f"origin {origin['lat_deg']:.6f}°, {origin['lon_deg']:.6f}°, {origin['alt_m']:.1f} m (WGS 84)"
        )
    else:
        facts.append("not georeferenced")
    if delivery := run.get("delivery"):
        facts.append(f"files in {delivery['crs']} (EPSG:{delivery['epsg']}), heights {delivery['heights']}")
    return f'<p class="facts">{escape(" · ".join(facts))}</p>'


def _picture(folder: Path, name: str) -> str:
    if not (folder / name).is_file():
        return ""
    data = base64.b64encode((folder / name).read_bytes()).decode("ascii")
    caption = escape(PICTURES[name])
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _warnings(warnings: Iterable[str]) -> str:
    return "\n".join(f'<p class="warning">{escape(str(warning))}</p>' for warning in warnings)


def _skips(skips: Mapping[str, Any]) -> str:
    listed = skips.get("listed", ())
    if not listed:
        return ""
    rows = [(skip["what"], skip["where"], skip["reason"]) for skip in listed[:MANY_SKIPS]]
    more = skips.get("count", len(listed)) - len(rows)
    return _table(("what", "where", "why"), rows) + (
        f"<p>and {more:,} more, which run.json lists</p>" if more > 0 else ""
    )


def _classes(about_map: Mapping[str, Any], semantics: Mapping[str, Any]) -> str:
    """Table of voxels, accuracy and IoU per class, before and after refinement, as far as known."""
    counts = about_map.get("labelled", {})
    names = list(dict.fromkeys(n for s in ("raw", "refined") for n in _class_names(counts, semantics, s)))
    columns: list[tuple[str, list[Any]]] = []
    for stage in ("raw", "refined"):
        if stage in counts:
            columns.append(
                (f"voxels, {stage}", [*map(counts[stage].get, names), sum(counts[stage].values())])
            )
    for stage, scores in semantics.items():
        for key in ("accuracy", "iou"):
            each = [(scores.get("classes", {}).get(name) or {}).get(key) for name in names]
            columns.append((f"{key}, {stage}", [*map(_percent, each), _percent(scores.get(f"mean_{key}"))]))
    if not columns:
        return ""
    rows = [(name, *(values[i] for _, values in columns)) for i, name in enumerate([*names, "all"])]
    remarks = {}
    for stage, scores in semantics.items():
        strict = scores.get("strict", {}).get("mean_iou")
        remarks[f"evaluated points that the {stage} map labels"] = _percent(scores.get("coverage"))
        remarks[f"mean iou, {stage}, if an unlabelled point is a miss"] = _percent(strict)
    known = {key: about_map[key] for key in ("voxels", "points", "points_removed") if key in about_map}
    return _pairs(known) + _table(("class", *(title for title, _ in columns)), rows) + _pairs(remarks)


def _class_names(counts: Mapping[str, Any], semantics: Mapping[str, Any], stage: str) -> list[str]:
    return [*counts.get(stage, {}), *semantics.get(stage, {}).get("classes", {})]


def _refinement(refinement: Mapping[str, Any]) -> str:
    steps = refinement.get("steps", ())
    changed = [
        (
            step["name"],
            step.get("voxels_changed"),
            "; ".join(f"{change}: {count:,}" for change, count in step.get("changes", {}).items())
            or step.get("skipped", ""),
        )
        for step in steps
    ]
    motions = [str(thing.get("motion")) for thing in refinement.get("objects", ())]
    vehicles = {f"vehicles, {motion}": motions.count(motion) for motion in sorted(set(motions))}
    table = _table(("step", "voxels changed", "of these"), changed) if changed else ""
    errors = {
        "systematic label error rate, estimated without truth": _percent(refinement.get("systematic_errors"))
    }
    return table + _pairs(vehicles | (errors if "systematic_errors" in refinement else {}))


def _drives(drives: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str]) -> str:
    """A row for every drive of the map, with its own report; and why others are not in it."""
    if not drives:
        return ""
    keys = list(next(iter(drives.values())))
    rows = "".join(
        f'<tr><td><a href="{escape(f"drives/{quote(name)}/report.html")}">{escape(name)}</a></td>'
        f"{''.join(_cell(_value(about.get(key)), number=True) for key in keys)}</tr>"
        for name, about in drives.items()
    )
    head = f'<tr><th>drive</th>{"".join(f"""<th class="number">{escape(_words(key))}</th>""" for key in keys)}</tr>'
    return f'<div class="scroll"><table>{head}{rows}</table></div>' + (
        f"<h3>Left out</h3>{_table(('drive', 'why'), list(failed.items()))}" if failed else ""
    )


def _passes(passes: Sequence[Mapping[str, Any]]) -> str:
    """How far the surfaces of two passes lay from each other, and lie now."""
    if not passes:
        return ""
    head = ("first pass", "again", "places registered", "bound", "surfaces apart before, cm", "after, cm")
    rows = [
        (row["first"], row["second"], row["places"], row["bound"],
         f"{100 * row['before_m']:.1f}", f"{100 * row['after_m']:.1f}")
        for row in passes
    ]  # fmt: skip
    return _table(head, rows)


def _changes(changes: Sequence[Mapping[str, Any]]) -> str:
    """Objects that stand in one session and not in the other one."""
    head = (
        "",
        "what",
        "kind",
        "between",
        "where (east, north, up), m",
        "size, m",
        "voxels",
        "seen through by scans",
    )
    rows = [
        (row["change"], row["class"], row["kind"], f"{row['before']} and {row['after']}",
         ",\u00a0".join(f"{axis:.1f}" for axis in row["centre_m"]),
         "\u00a0x\u00a0".join(f"{axis:.1f}" for axis in row["size_m"]),
         row["voxels"], f"{row['seen_through']:g}")
        for row in changes
    ]  # fmt: skip
    return _table(head, rows) if rows else ""


def _stages(seconds: Mapping[str, float], memory_mb: Mapping[str, float]) -> str:
    longest = max(seconds.values(), default=0) or 1
    rows = "".join(
        f"<tr><td>{escape(stage)}</td>{_cell(f'{value:,.2f} s', number=True)}"
        f"{_cell(_value(memory_mb.get(stage)), number=True)}"
        f'<td><span class="bar" style="width:{BAR_PX * value / longest:.0f}px"></span></td></tr>'
        for stage, value in seconds.items()
    )
    head = (
        '<tr><th>stage</th><th class="number">time</th><th class="number">peak memory (MB)</th><th></th></tr>'
    )
    return f"<table>{head}{rows}</table>" if rows else ""


def _files(folder: Path) -> str:
    rows = "".join(
        f'<tr><td><a href="{escape(name)}">{escape(name)}</a></td>'
        f"{_cell(_size(folder / name), number=True)}<td>{escape(what)}</td></tr>"
        for name, what in FILES.items()
        if (folder / name).exists()
    )
    return f"<table>{rows}</table>" if rows else ""


def _size(path: Path) -> str:
    if path.is_dir():
        return f"{sum(1 for _ in path.iterdir()):,} files"
    return f"{path.stat().st_size / 1e3:,.1f} kB"


def _pairs(values: Mapping[str, Any]) -> str:
    """A table of names and values; absent values and nested tables are left out."""
    rows = [(_words(k), _value(v)) for k, v in values.items() if v is not None and not isinstance(v, Mapping)]
    return (
        f"<table>{''.join(f'<tr><th>{escape(k)}</th>{_cell(v)}</tr>' for k, v in rows)}</table>"
        if rows
        else ""
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [f"<tr>{''.join(_cell(_value(v), number=_is_number(v)) for v in row)}</tr>" for row in rows]
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f'<div class="scroll"><table><tr>{titles}</tr>{"".join(lines)}</table></div>'


def _cell(text: str, number: bool = False) -> str:
    return f'<td class="number">{escape(text)}</td>' if number else f"<td>{escape(text)}</td>"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) or (isinstance(value, str) and value.endswith(" %"))


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.1f} %"


def _shares(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same metrics with fractions as percentages."""
    return {key: _percent(value) if isinstance(value, float) else value for key, value in values.items()}


def _value(value: Any) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.4g}"
        case list() | tuple():
            return ", ".join(map(_value, value))
        case _:
            return str(value)


def _words(key: str) -> str:
    """`peak_memory_mb` -> `peak memory (MB)`, and some abbreviations spelt out."""
    if key in WORDS:
        return WORDS[key]
    *words, last = key.split("_")
    return " ".join([*words, f"({UNITS[last]})"] if words and last in UNITS else [*words, last])
