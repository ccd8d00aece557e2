"""What a client wants to know first, in words: how much, how accurate, what is missing and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gnss_sem_map.errors import counted
from gnss_sem_map.export.overview import Overview
from gnss_sem_map.export.track import Track


@dataclass(frozen=True)
class Verdict:
    """The top of a report."""

    doubts: int
    """Warnings, findings of the pre-flight and drives that are left out."""
    headline: str
    sentences: tuple[str, ...]


def verdict_of(
    run: Mapping[str, Any], metrics: Mapping[str, Any], overview: Overview | None, tracks: Sequence[Track]
) -> Verdict:
    """The verdict on a run; what is not known is said to be so."""
    findings = run.get("preflight", {}).get("findings", ())
    raised = sum(found["level"] != "green" for found in findings)
    doubts = max(raised, len(run.get("warnings", ()))) + len(run.get("failed", {}))
    if doubts:
        headline = f"The map is made; {counted(doubts, 'remark')} below must be read before it is used."
    elif findings:
        headline = (
            f"The map is made, and none of {counted(len(findings), 'check')} of the recording found a fault."
        )
    else:
        headline = (
            "The map is made. Checks of the recording are in the reports of its drives, or were not recorded."
        )
    sentences = (
        _size(run, overview, tracks),
        *_accuracy(metrics, tracks),
        *_classes(metrics),
        *_without_class(overview),
        *_passes(run),
        *_missing(run),
        _coordinates(run),
    )
    return Verdict(doubts, headline, sentences)


def _size(run: Mapping[str, Any], overview: Overview | None, tracks: Sequence[Track]) -> str:
    drives = f" in {counted(len(tracks), 'drive')}" if len(tracks) > 1 else ""
    length = sum(track.length_m for track in tracks)
    way = f"{_length(length)} driven{drives}" if tracks else "The driven length is not known"
    of_drives = [about.get("scans", 0) for about in run.get("drives", {}).values()]
    scans = run.get("counts", {}).get("scans", sum(of_drives) or None)
    seen = f" with {counted(scans, 'laser scan')}" if scans is not None else ""
    if overview is None:
        return f"{way}{seen}; the mapped area is not known."
    return (
        f"{way}{seen}; {overview.area_m2:,.0f} m² of ground plan are mapped"
        " (squares with at least one measured point)."
    )


def _accuracy(metrics: Mapping[str, Any], tracks: Sequence[Track]) -> Iterator[str]:
    scores = metrics.get("trajectory", {})
    if scores:
        aligned, inside = scores.get("ate_aligned_m"), scores.get("position_inside_95")
        shape = "" if aligned is None else f" ({_metres(aligned)} after alignment: the shape of the way)"
        covered = (
            "" if inside is None else f"; the stated 95 % bounds hold {100 * inside:.0f} % of the errors"
        )
        yield (
            f"Positions, measured against the given truth: {_metres(scores['ate_m'])} root mean square error"
            f"{shape}{covered}."
        )
    known = [
        track for track in tracks if track.horizontal_95_m is not None and track.vertical_95_m is not None
    ]
    if not known:
        if not scores:
            yield "The accuracy of the positions is not known: no uncertainty came with them, and no truth was given."
        return
    plane, height = (
        np.concatenate([values for track in known if (values := getattr(track, name)) is not None])
        for name in ("horizontal_95_m", "vertical_95_m")
    )
    checked = "" if scores else " It was not checked against independent survey points."
    only = f" (of {len(known)} of {len(tracks)} drives)" if len(known) < len(tracks) else ""
    yield (
        f"Positions, own estimate{only}: with 95 % probability within {_metres(np.median(plane))} in the plane and"
        f" {_metres(np.median(height))} in height at the median place, {_metres(plane.max())} and"
        f" {_metres(height.max())} at the worst.{checked}"
    )


def _classes(metrics: Mapping[str, Any]) -> Iterator[str]:
    refined = metrics.get("semantics", {}).get("refined", {})
    if refined.get("mean_accuracy") is None:
        yield "The accuracy of the classes is not known: no truth was given."
        return
    yield (
        f"Classes, measured against the given truth: {100 * refined['mean_accuracy']:.1f} % of the labelled"
        f" points are right (mean over the classes); {100 * (refined.get('coverage') or 0):.1f} % of"
        " the points whose true class the map has carry a label."
    )


def _without_class(overview: Overview | None) -> Iterator[str]:
    if overview is None:
        return
    reasons = (
        (overview.not_looked_at, "no labelled image shows"),
        (overview.undecided, "images give no clear class to"),
    )
    why = [f"{reason} {100 * share:.1f} %" for share, reason in reasons if share >= 0.0005]
    if why:
        share = 100 * (overview.not_looked_at + overview.undecided)
        yield f"Without a class: {share:.1f} % of the laser points that stay in the map ({', '.join(why)})."


def _passes(run: Mapping[str, Any]) -> Iterator[str]:
    passes = run.get("passes", ())
    if passes:
        before, after = (max(row[key] for row in passes) for key in ("before_m", "after_m"))
        yield (
            f"{counted(len(passes), 'pair')} of passes over the same places: surfaces lay up to {100 * before:.1f} cm"
            f" apart, and lie up to {100 * after:.1f} cm apart now."
        )


def _missing(run: Mapping[str, Any]) -> Iterator[str]:
    for name, why in run.get("failed", {}).items():
        yield f"Not in the map: the drive {name} ({why})."
    skips = run.get("skips", {})
    reasons = Counter(str(skip["reason"]) for skip in skips.get("listed", ()))
    if reasons:
        why = "; ".join(reason for reason, _ in reasons.most_common(3))
        yield f"{counted(skips.get('count', sum(reasons.values())), 'part')} of the recording could not be used: {why}."
    elif "count" in skips:
        yield "All of the recording could be used."
    if trajectory := run.get("trajectory"):
        rejected, fixes = trajectory.get("fixes_rejected"), trajectory.get("fixes")
        if rejected is not None and fixes is not None:
            outside = trajectory.get("fixes_outside_imu", 0)
            unused = f"; {outside:,} were not used: the IMU recorded nothing at their time" if outside else ""
            yield f"{rejected:,} of {fixes:,} satellite positions were rejected as wrong{unused}."
    about_map = run.get("map", {})
    if about_map.get("points_removed") and about_map.get("points"):
        share = about_map["points_removed"] / about_map["points"]
        yield (
            f"Removed as moving objects: {about_map['points_removed']:,} laser points ({100 * share:.1f} %);"
            " removed.laz has their voxels."
        )


def _coordinates(run: Mapping[str, Any]) -> str:
    delivery = run.get("delivery")
    if delivery is None:
        return (
            "The files have no known coordinates on the Earth."
            if not run.get("local_frame")
            else "Coordinates: see the files."
        )
    return f"Coordinates: {delivery['crs']} (EPSG:{delivery['epsg']}); heights {delivery['heights']}."


def _length(metres: float) -> str:
    return f"{metres / 1000:,.2f} km" if metres >= 1000 else f"{metres:,.0f} m"


def _metres(metres: float) -> str:
    return f"{metres:.2f} m" if metres >= 0.1 else f"{100 * metres:.1f} cm"
