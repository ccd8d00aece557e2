"""Geometric classifiers of a map on disk: each drive has its own, or all have one that the settings name.

drives/NAME/evidence/classifier.npz    the classifier of a drive, or evidence/classifier.npz of a run of one drive

It judges the voxels of its own drive, by what this drive measured alone. In a map of several, what the drives say of a
voxel is averaged: so a drive that is added or taken out changes nothing where it was not.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import open_archive
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.untrusted import is_file, is_folder, read_bytes, shown
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.geometric_classifier import classifier, features, road_sidewalk, training
from gnss_sem_map.geometric_classifier.classifier import LEVELS, Classifier
from gnss_sem_map.geometric_classifier.features import features_of
from gnss_sem_map.geometric_classifier.road_sidewalk import RoadSidewalkModel
from gnss_sem_map.geometric_classifier.training import Rows, rows_of
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.raw_map import MAP, RawMap, open_raw
from gnss_sem_map.process.execution import Executor, InProcess, Task, path_of, run_tasks
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.refinement import geometric_prior, height_above_ground, potts_mrf
from gnss_sem_map.refinement.state import Evidence, GeometricEvidence
from gnss_sem_map.voxels.attributes import NOTHING, Attributes, open_attributes
from gnss_sem_map.voxels.blocks import Block, blocks_of
from gnss_sem_map.voxels.kernels import UNITS_PER_NAT
from gnss_sem_map.voxels.map_json import files_of, tile_of
from gnss_sem_map.voxels.reuse import digest
from gnss_sem_map.voxels.tiles import Recent, indices_by_tile, places_around

FILE = "classifier.npz"
MOST_BLOCKS = 64
"""Of a long drive so many blocks, evenly spread, teach its classifier."""
OFF = "only what images show has a class"
VOXELS_AT_ONCE = 1 << 18
"""Their features take 66 MB."""


def drive_folders(run: Path) -> list[Path]:
    """The folders of a run that have a raw map of one drive each, sorted by name."""
    return sorted((run / DRIVES).iterdir()) if is_folder(run / DRIVES) else [run]


def opened_model(settings: Settings) -> Classifier | None:
    """The classifier that the settings name and use; raises DataError if it is damaged, or of other maps."""
    chosen = settings.geometric_classifier
    if not chosen.enabled or chosen.model is None:
        return None
    return classifier.read(chosen.model, open_label_set(settings.classes), settings.mapping.voxel_size_m)


def fit_classifiers(run: Path, settings: Settings, executor: Executor | None = None) -> list[str]:
    """Write the classifier of every drive of a run that lacks it; what the user is to know, a line each.

    Drives are tasks of `executor`, by default in this process. Raises DataError.
    """
    if not settings.geometric_classifier.enabled:
        return []
    folders = drive_folders(run)
    tasks = [Task(folder.name, FIT, (str(folder), settings.model_dump_json())) for folder in folders]
    said = dict(run_tasks(tasks, executor if executor and len(tasks) > 1 else InProcess()))
    several = len(tasks) > 1
    return [
        f"{task.name}: {said[task]}" if several else said[task]
        for task in tasks
        if said[task] and training.NO_LABELS not in said[task]  # mapping said so, and what to do
    ]


def fit_classifier(folder: str, settings: str) -> str:
    """Write the classifier of a drive, unless it is there; why it has none, or nothing: a task."""
    release_memory()
    return DriveClassifier(Path(folder), Settings.model_validate_json(settings)).fit()


FIT = path_of(fit_classifier)


def drives_of(run: Path, settings: Settings) -> list[DriveClassifier]:
    """The drives of a run with their classifiers."""
    return [DriveClassifier(folder, settings) for folder in drive_folders(run)]


@dataclass(frozen=True, eq=False)
class DriveClassifier:
    """The raw map of a drive in its folder, and its geometric classifier beside it."""

    folder: Path
    settings: Settings

    def fit(self) -> str:
        """Write the classifier, unless one made from the same is there; returns why there is none, or nothing."""
        if (there := self._written) is not None:
            return there if isinstance(there, str) else ""
        found: Classifier | str
        named, model = self.settings.geometric_classifier.model, opened_model(self.settings)
        if named is None or model is None:
            size = self._raw.fused.voxel_size_m
            found = training.fit([self.rows()], self._label_set, size, self.has_intensity)
            found = f"{found}: {OFF}" if isinstance(found, str) else found
        elif model.uses_intensity and not self.has_intensity:
            found = f"its scans have no intensities, as those that {shown(named.name)} was fitted to: {OFF}"
        else:
            found = model
        why = found if isinstance(found, str) else ""
        beside = {"made_from": np.array([self.digest]), "why": np.array([why])}
        file = io.BytesIO()
        if isinstance(found, str):
            np.savez(file, allow_pickle=False, **beside)
        write_whole(
            self._file, found.to_bytes(**beside) if isinstance(found, Classifier) else file.getvalue()
        )
        return why

    def rows(self) -> Rows:
        """Training rows of the voxels of the drive that images show."""
        settings, size = self.settings, self._raw.fused.voxel_size_m
        most, steps = settings.geometric_classifier.rows_per_fold, settings.refinement
        by_steps = geometric_prior.reach_m(steps.geometric_prior, size) + potts_mrf.reach_m(
            steps.potts_mrf, size
        )
        margin = max(features.reach_m(size), height_above_ground.REACH_M + by_steps)
        model = sensor_model.opened(settings.calibration, self._label_set)
        files = files_of(self.folder / MAP)
        blocks = blocks_of({tile_of(name): about["voxels"] for name, about in files.items()})
        step = -(-len(blocks) // MOST_BLOCKS)
        found: Rows | None = None
        for block in blocks[::step]:
            around = self._raw.around(block, margin)
            places = places_around(around, block, 0)
            rows = rows_of(
                around, self._intensity_of(around.keys), places, Evidence(None, model), steps, most
            )
            found = rows if found is None else (found + rows).first(most)
            release_memory()
        assert found is not None
        return found

    def geometric_evidence(self, block: Block, margin_m: float) -> GeometricEvidence | None:
        """What the classifier says of the voxels of a block and a margin around it; None where there is none."""
        model = self._model
        if model is None:
            return None
        around = self._raw.around(block, margin_m + features.reach_m(self._raw.fused.voxel_size_m))
        places = places_around(around, block, margin_m)
        intensity, keys, said = self._intensity_of(around.keys), around.keys[places], []
        kerbs = RoadSidewalkModel(road_sidewalk.shipped(), self.settings.geometric_classifier.kerb_weight)
        for part in np.split(places, range(VOXELS_AT_ONCE, len(places), VOXELS_AT_ONCE)):
            rows = features_of(around, intensity, part)
            logs = model.log_probabilities(rows, around.keys[part], around.observed[part])
            said.append(np.column_stack([logs, kerbs.log_odds(rows, logs, self._label_set)]))
        # as whole numbers, whose sums are the same in any order of the drives
        sums = np.rint(np.concatenate(said) * np.float32(UNITS_PER_NAT)).astype(np.int32)
        return GeometricEvidence(keys, sums, np.ones(len(keys), np.int32))

    @cached_property
    def digest(self) -> str:
        """Of all that the classifier is made from."""
        settings, moved = self.settings, self.folder / evidence.FOLDER / evidence.MOVED
        named = settings.geometric_classifier.model
        model = sensor_model.opened(settings.calibration, self._label_set)
        return digest([
            settings.geometric_classifier.model_dump(mode="json", exclude={"model"}),
            None if named is None else hashlib.sha256(read_bytes(named)).hexdigest(),
            [getattr(settings.refinement, name).model_dump(mode="json") for name in training.LABELLED_BY],
            self._label_set.about(),
            None if model is None else repr(model.to_yaml()),
            [{name: about["sha256"] for name, about in files_of(of).items()} for of in (self.folder / MAP, moved)],
        ])  # fmt: skip

    @cached_property
    def has_intensity(self) -> bool:
        """Whether the points of the drive differ in intensity."""
        return bool(np.count_nonzero(self._counts_of_intensity) > 1)

    @property
    def _file(self) -> Path:
        return self.folder / evidence.FOLDER / FILE

    @property
    def _written(self) -> Classifier | str | None:
        """The written classifier, or why there is none; None for one made from other things, or a damaged one."""
        if not is_file(self._file):
            return None
        try:
            with open_archive(self._file) as archive:
                made_from, why = (str(archive.array(name).read()[0]) for name in ("made_from", "why"))
            if made_from != self.digest:
                return None
            return why or classifier.read(self._file, self._label_set, self._raw.fused.voxel_size_m)
        except (DataError, IndexError):
            return None

    @cached_property
    def _model(self) -> Classifier | None:
        written = self._written
        return written if isinstance(written, Classifier) else None

    @cached_property
    def _label_set(self) -> LabelSet:
        return open_label_set(self.settings.classes)

    @cached_property
    def _raw(self) -> RawMap:
        return open_raw(self.folder, self._label_set)

    def _intensity_of(self, keys: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Intensities of voxels (v,), as the share of the voxels of the drive that have less, 0 to 255.

        So they mean the same for every LiDAR, whatever its scale.
        """
        found = np.zeros(len(keys), np.uint8)
        for tile, places in indices_by_tile(keys):
            found[places] = self._attributes(tile).of(keys[places]).intensity
        counts = self._counts_of_intensity
        ranks = (255 * (2 * np.cumsum(counts) - counts)) // np.maximum(2 * counts.sum(), 1)
        return np.asarray(ranks.astype(np.uint8)[found])

    @cached_property
    def _attributes(self) -> Recent[Attributes]:
        """Reads those of a tile, none where the folder has no attributes."""
        opened = open_attributes(self.folder)
        return Recent(lambda tile: NOTHING if opened is None else opened.read_tile(tile))

    @cached_property
    def _counts_of_intensity(self) -> NDArray[np.int64]:
        """Voxels of each level of intensity (256,)."""
        counts = np.zeros(LEVELS, np.int64)
        for tile in self._raw.fused.tiles:
            counts += np.bincount(self._attributes(tile).intensity, minlength=LEVELS)
        return counts


def geometric_evidence(
    drives: Sequence[DriveClassifier], block: Block, margin_m: float
) -> GeometricEvidence | None:
    """What the classifiers of all drives say of a block and a margin around it, added; None where none says any."""
    found = [one for drive in drives if (one := drive.geometric_evidence(block, margin_m)) is not None]
    return reduce(GeometricEvidence.__add__, found) if found else None
