"""One geometric classifier for many runs, from the labels of their images."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.output_folder import read_whole
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.geometric_classifier import classifier, training
from gnss_sem_map.geometric_classifier.classifier import Classifier
from gnss_sem_map.geometric_classifier.training import Rows
from gnss_sem_map.mapping.classifying import drives_of
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.runs.finished_run import Run


def fit_classifier(runs: Sequence[Path | str], progress: Progress = silent) -> tuple[Classifier, int]:
    """Fit a geometric classifier to all drives of finished runs; also how many drives there are.

    Scans and images are not needed. Raises DataError where the runs do not fit together, or their images label too few
    voxels.
    """
    rows: list[Rows] = []
    kind, first = None, None
    for done, out in enumerate(map(Path, runs)):
        progress("classifier", done, len(runs))
        with read_whole(out):
            run = Run.open(out)
            for drive in drives_of(out, run.settings):
                found = run.label_set.names, run.settings.mapping.voxel_size_m, drive.has_intensity
                kind, first = kind or found, first or run
                if found != kind:
                    raise DataError(
                        f"{shown(drive.folder)}: has {_said(*found)}; the drives before have {_said(*kind)}: fit a"
                        " classifier to drives of one kind"
                    )
                rows.append(drive.rows())
    if kind is None or first is None:
        raise DataError("fit-classifier: found no run folder, expected at least one")
    fitted = training.fit(rows, first.label_set, kind[1], kind[2])
    if isinstance(fitted, str):
        raise DataError(f"fit-classifier: {fitted}; give runs that were made with --segmenter")
    return fitted, len(rows)


def _said(names: tuple[str, ...], voxel_size_m: float, has_intensity: bool) -> str:
    intensity = "intensities" if has_intensity else "no intensities"
    return f"the classes {list(names)[:9]}, voxels of {voxel_size_m:g} m and {intensity}"


def check_replaceable(file: Path) -> None:
    """Raise DataError when the file exists and is no classifier: it would be overwritten."""
    if os.path.lexists(file) and not classifier.is_classifier(file):
        raise DataError(f"{shown(file)}: is there already, and is no geometric classifier; choose another -o")
