"""Two run folders become a third: both maps in the frame of the first, added, refined again and exported."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import config
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.run_folder import claimed_run
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.files.output_folder import new_folder
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.merging import Laid, merge_runs
from gnss_sem_map.refinement import refine
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.voxel_map import SemanticMap


def merge_run_folders(first: Path, second: Path, out: Path, match: bool = True) -> dict[str, Any]:
    """Write the merged run into `out`, refined with the settings of the first; returns the content of run.json.

    The second is laid onto the first where the two `match`; pictures show the track of the first. Raises DataError for
    folders that hold no run, a run with itself, and maps that do not fit together.
    """
    for run in (first, second):
        read_run(run)
    if first.resolve() == second.resolve():
        raise DataError(
            f"{second}: is the first run as well; merged with itself, all it saw would count twice; give another run"
        )
    with claimed_run(out, [first, second]):
        return _merge(first, second, out, match)


def _merge(first: Path, second: Path, out: Path, match: bool) -> dict[str, Any]:
    settings = config.load(first / "config.yaml")
    label_set = open_label_set(settings.classes)
    merged = merge_runs(first, second, label_set, match)
    calibration = sensor_model.opened(settings.calibration, label_set)
    refined, _ = refine(merged.stands, settings.refinement, merged.removed, calibration=calibration)
    raw, frame = SemanticMap.of(merged.stands + merged.removed), merged.frame
    driven = Trajectory.load(first / "trajectory.parquet")
    about = {
        "name": f"{first.name} + {second.name}",
        "merged": [first.name, second.name],
        "local_frame": asdict(frame),
        "map": {"voxels": len(raw), "points": int(raw.voxels.hits.sum())},
        "match": _about(merged.laid),
    }
    with new_folder(out) as folder:
        tiles.write(raw, folder / "map", frame)
        tiles.write(refined, folder / "refined", frame)
        write_ply(refined, folder / "map.ply", frame)
        write_laz(refined, frame, folder / "map.laz")
        write_topview_geotiff(refined, frame, folder / "topview_class.tif")
        write_topview(refined, folder / "topview.png", driven, title=str(about["name"]))
        write_perspective(refined, folder / "perspective.png", driven)
        write_viewer(refined, driven, folder / "viewer.html", title=str(about["name"]))
        (folder / "config.yaml").write_text(settings.to_yaml(), "utf-8")
        (folder / "run.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
    return about


def _about(laid: Laid) -> dict[str, Any]:
    """How the second map came to lie on the first, for run.json."""
    found = laid.match
    return {
        "shift_m": None if found is None else round(found.shift_m, 3),
        "turn_deg": None if found is None else round(found.turn_deg, 3),
        "T_first_second": None if found is None else found.T_target_source.tolist(),
        "reason": laid.reason,
        "coinciding": dict(zip(("by_georeference", "now"), laid.coinciding, strict=True)),
    }
