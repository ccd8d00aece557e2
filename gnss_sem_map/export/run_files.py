"""What a run folder holds: its files and folders, and what each of them is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gnss_sem_map.export.formats import FORMATS

FILES = {
    **{each.file: each.what for each in FORMATS},
    "viewer": "the finer voxels of viewer.html, where the map is too large for one page",
    "trajectory.png": "the trajectory and its GNSS fixes",
    "trajectory.parquet": "poses of the IMU in the map, velocities and covariances",
    "trajectory_alone.parquet": "the same before places that were passed again bound them",
    "trajectory.tum": "the poses as stamp, position and quaternion, for evo",
    "trajectory_covariance.tum": "the same with the covariance of every pose, for smfeval",
    "trajectory_kitti.txt": "the poses as 3 x 4 matrices, for KITTI tools",
    "trajectory.geojson": "the track in WGS 84, for web maps and QGIS",
    "trajectory_wgs84.parquet": "the track in WGS 84 with time, speed and standard deviations, as GeoParquet",
    "trajectory.sbet": "the same as SBET, for tools of inertial post-processing",
    "trajectory_attitude.csv": "roll, pitch, heading, standard deviations and fixes along the track",
    "objects.parquet": "what moved: a row per object with its track, size, speed and evidence, as GeoParquet",
    "objects.geojson": "the same in WGS 84, for web maps and QGIS",
    "map": "the map before refinement, with all evidence, as Parquet tiles",
    "refined": "the refined map as Parquet tiles",
    "drives": "map, evidence, trajectory and report of each of several drives",
    "changes.geojson": "what changed between drives, as boxes in WGS 84, for web maps and QGIS",
    "changes.laz": "the voxels of what changed, as map.laz; user_data 1: appeared, 2: vanished",
    "attributes": "when each voxel was last seen, and the intensity of its points, as Parquet tiles",
    "evidence": "what else the run knows, so that `gnss-sem-map refine` needs no scans",
    "labels": "the class of every LiDAR point, SemanticKITTI raw ids, one file per scan",
    "labels_raw": "the same before refinement",
    "confidence": "the probability of each of these labels, float16",
    "looks": "the LiDAR points of the voxel of each of these points, at most 255, uint8",
    "removed": "1 for every LiDAR point on a moving vehicle that was taken out of the map",
    "config.yaml": "all settings of this run",
    "classes.yaml": "the class set that the settings name",
    "calibration.yaml": "the confusion model of the segmentation network that the settings name",
    "classifier.npz": "the geometric classifier that the settings name",
    "run.json": "what report.html says of the run, machine-readable",
    "metrics.json": "what report.html says of the evaluation, machine-readable",
}
"""Name -> content; report.html, which lists them, is not among them."""


def listed(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Those that a run folder has: name, size and content."""
    for name, what in FILES.items():
        if (folder / name).exists():
            yield name, _size(folder / name), what


def _size(path: Path) -> str:
    if path.is_dir():
        return f"{sum(1 for _ in path.iterdir()):,} files"
    return f"{path.stat().st_size / 1e3:,.1f} kB"
