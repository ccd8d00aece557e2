"""Two run folders become a third: both maps in the frame of the first, added, refined again and exported."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gnss_sem_map import config, label_calibration, labels, tiles
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.pictures import write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.run_folder import new_folder
from gnss_sem_map.merging import merge_runs
from gnss_sem_map.refinement import refine
from gnss_sem_map.voxel_map import SemanticMap


def merge_run_folders(first: Path, second: Path, out: Path) -> dict[str, Any]:
    """Write the merged run into `out`, refined with the settings of the first; returns the content of run.json.

    Raises DataError for folders that hold no run, a run with itself, and maps that do not fit together.
    """
    for run in (first, second):
        if not (run / "run.json").is_file():
            raise DataError(f"{run}: no run folder here; expected the -o of an earlier `gnss-sem-map run`")
    if first.resolve() == second.resolve():
        raise DataError(
            f"{second}: is the first run as well; merged with itself, all it saw would count twice; give another run"
        )
    settings = config.load(first / "config.yaml")
    label_set = labels.label_set(settings.classes)
    static, removed, frame = merge_runs(first, second, label_set)
    calibration = label_calibration.opened(settings.calibration, label_set)
    refined, _ = refine(static, settings.refinement, removed, calibration=calibration)
    raw = SemanticMap.of(static + removed)
    about = {
        "name": f"{first.name} + {second.name}",
        "merged": [first.name, second.name],
        "local_frame": asdict(frame),
        "map": {"voxels": len(raw), "points": int(raw.voxels.hits.sum())},
    }
    with new_folder(out) as folder:
        tiles.write(raw, folder / "map", frame)
        tiles.write(refined, folder / "refined", frame)
        write_ply(refined, folder / "map.ply", frame)
        write_laz(refined, frame, folder / "map.laz")
        write_topview_geotiff(refined, frame, folder / "topview_class.tif")
        write_topview(refined, folder / "topview.png", title=str(about["name"]))
        (folder / "config.yaml").write_text(settings.to_yaml(), "utf-8")
        (folder / "run.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
    return about
