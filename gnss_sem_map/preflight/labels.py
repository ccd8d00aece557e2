"""Checks of labels from files: they are not empty or constant, and they belong to these images.

A network is not asked: that is what takes the time of a run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.probabilities import LabelImage
from gnss_sem_map.preflight.camera_pose import (
    LEAST_BEST,
    LEAST_VIEWS,
    SURE,
    TURNS,
    best_change,
    in_errors,
)
from gnss_sem_map.preflight.camera_sample import CameraSample
from gnss_sem_map.preflight.depth_edges import UNCHANGED, Change, Edges, View, border_strength
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.segmentation import MissingLabels, Segmenter
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.segmentation.classes import unknown_classes

NAME, PLACE, NAMES = "labels", "labels against LiDAR", "class names"
MOST_REFUSED = 0.5
"""Of the label files looked at; with more of them refused, the map would miss most of its labels."""
ONE_CLASS = 0.97
"""No camera of a road sees only one class, image after image."""
LEAST_KNOWN = 0.01
LEAST_COMMON = 0.1
"""Borders of labels at depth edges beyond those of other frames, over their mean (good drives: 0.4 up)."""
UNKNOWN = -1


def check(sample: CameraSample, against_lidar: bool) -> Iterator[Finding]:
    """Only labels from files: what they hold, and whether it fits the scans."""
    segmenter, edges = sample.drive.segmenter, sample.edges
    if not isinstance(segmenter, CachedLabels) or edges is None:
        return
    views: list[View] = []
    seen: list[NDArray[np.int64]] = []
    errors: list[DataError] = []
    for view, image in zip(edges.views, sample.edge_images, strict=True):
        try:
            classes = classes_of(segmenter.kept(image))
        except DataError as error:
            errors.append(error)
            continue
        seen.append(classes)
        coarse, fine = border_strength(classes, sample.camera.image_size)
        views.append(View(view.p_map, view.weights, view.stamp, coarse, fine))
    refused = [error for error in errors if not isinstance(error, MissingLabels)]
    if lost := refused or (errors if not seen else []):
        count = len(seen) + len(lost)
        yield (red if len(refused) > MOST_REFUSED * count else amber)(
            NAME,
            f"labels of {len(lost)} of {count} frames looked at are refused or missing: {lost[0]}",
            "label files are damaged, of other frames, or of other classes",
            segmenter.remedy if refused else "check the frame numbers in the names of the label files",
        )
    if not seen:
        return
    content = _content(seen, segmenter.class_names, segmenter.remedy)
    yield content
    if against_lidar and not content.mistake:
        yield _place(sample, replace(edges, views=tuple(views)))


def check_names(segmenter: Segmenter | None, label_set: LabelSet) -> Iterator[Finding]:
    """The class names of any segmenter: unknown ones are listed, in one finding."""
    found = None if segmenter is None else unknown_classes(segmenter.class_names, label_set)
    if found is not None:
        yield amber(
            NAMES,
            found,
            "the class set does not know them",
            "name them with ?classes=..., or in the `sources` of the class set file",
        )


def classes_of(labels: NDArray[np.uint8] | NDArray[np.float32] | LabelImage) -> NDArray[np.int64]:
    """The class of every pixel (h, w), -1 where nothing is known."""
    if isinstance(labels, LabelImage):
        of_id = np.where(labels.table.any(axis=1), labels.table.argmax(axis=1), UNKNOWN)
        return np.asarray(of_id[labels.ids], np.int64)
    some = labels[::2, ::2]
    return np.where(some.any(axis=2), some.argmax(axis=2), UNKNOWN)


def _content(seen: list[NDArray[np.int64]], names: tuple[str, ...], remedy: str) -> Finding:
    known = np.concatenate([classes[classes != UNKNOWN] for classes in seen])
    share = len(known) / sum(classes.size for classes in seen)
    if share < LEAST_KNOWN:
        return red(
            NAME,
            f"{share:.1%} of the pixels of {len(seen)} label files have any class",
            "labels are all zero: they hold no class at all",
            remedy,
        )
    counts = np.bincount(known)
    top = int(counts.argmax())
    largest = counts[top] / len(known)
    name = names[top] if top < len(names) else str(top)
    found = f"{len(seen)} files, {share:.0%} of the pixels known, {largest:.0%} of them {name}"
    if largest > ONE_CLASS:
        return red(
            NAME,
            found,
            f"labels have one class, {name}, nearly everywhere, the sky as well: all zero, or ids of another kind",
            remedy,
        )
    return green(NAME, found)


def _place(sample: CameraSample, edges: Edges) -> Finding:
    given = edges.agreement()
    common = (given - edges.others())[np.isfinite(given)]
    if len(common) < LEAST_VIEWS or not sample.drive.is_moving:
        return green(PLACE, "not observable: too few labelled scans with depth edges, or the vehicle stands")
    found = (
        f"borders of labels at depth edges of {len(common)} scans: {np.nanmean(given):.2f} times those elsewhere,"
        f" {common.mean():+.2f} against labels of other frames"
    )
    best = best_change(edges, TURNS[:2])
    if (
        best.sigmas > SURE
        and best.agreement > LEAST_BEST
        and abs(best.value) > 2 * best.family.same
        and best.gain > 2 * max(common.mean(), 0.0)
        and _belong_together(edges, best.family.of(best.value))
    ):
        pixels = abs(np.tan(np.radians(best.value)) * edges.camera.K[0, 0])
        return red(
            PLACE,
            found,
            f"labels are shifted by about {pixels:.0f} pixels"
            f" {'to the side' if best.family is TURNS[0] else 'up or down'} against the images",
            "make labels of the whole rectified images",
        )
    if not _belong_together(edges, UNCHANGED):
        return amber(
            PLACE,
            found,
            "labels are of other frames, or of another drive: they do not fit the scans of their number",
            "check that <frame number> of each label file is that of its image",
        )
    return green(PLACE, found)


def _belong_together(edges: Edges, change: Change) -> bool:
    """Whether depth edges meet the labels of their own frame better than those of others."""
    own = edges.agreement(change)
    common = (own - edges.others(change))[np.isfinite(own)]
    return len(common) > 1 and float(common.mean()) >= LEAST_COMMON and in_errors(common) >= 2.0
