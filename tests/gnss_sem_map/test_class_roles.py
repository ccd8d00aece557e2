"""What the map asks of a class is its role, whatever its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
from street import Street

from gnss_sem_map import Run
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.mapping.evidence import write_moving_points
from gnss_sem_map.mapping.point_labels import label_points
from gnss_sem_map.runs import finished_run
from gnss_sem_map.voxels import tiles


def class_set(file: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> str:
    """A file of the five classes and their roles, each changed."""
    urban = open_label_set()
    rows = [row | {"role": role} for row, role in zip(urban.about()["classes"], urban.roles, strict=True)]
    sources = {"labels": {row["name"]: change(row)["name"] for row in rows}}
    file.write_text(json.dumps({"name": "mine", "classes": [*map(change, rows)], "sources": sources}))
    return str(file)


def test_roles_decide_and_names_of_classes_mean_nothing(
    small_drive: Street, finished: Run, tmp_path: Path
) -> None:
    file = class_set(tmp_path / "mine.yaml", lambda row: row | {"name": row["name"][::-1]})
    settings = finished.settings.changed(f"classes={file}")
    out = finished_run.run(
        small_drive.drive,
        tmp_path / "out",
        f"labels:{small_drive.labels}",
        settings,
        write_labels=True,
        force=True,
    )
    assert out.label_set.names == tuple(name[::-1] for name in finished.label_set.names)
    for refined in (False, True):
        here, there = out.map(refined=refined), finished.map(refined=refined)
        for name in ("labels", "confidence", "states"):
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
        for name in ("keys", "evidence", "hits"):
            np.testing.assert_array_equal(getattr(here.voxels, name), getattr(there.voxels, name))
    for folder in ("labels", "removed", "confidence"):
        for path in (finished.folder / folder).iterdir():
            assert (out.folder / folder / path.name).read_bytes() == path.read_bytes()
    layers = [pyogrio.list_layers(one.folder / "map.gpkg").tolist() for one in (finished, out)]
    assert layers[0] == layers[1]
    for layer, _ in layers[0]:
        known = [
            pyogrio.read_info(one.folder / "map.gpkg", layer=layer)["features"] for one in (finished, out)
        ]
        assert known[0] == known[1], layer


def test_points_that_moved_through_what_stands_are_of_the_class_of_their_object(
    small_drive: Street, finished: Run, tmp_path: Path
) -> None:
    """Compared point by point with all others; the building walks here."""
    file = class_set(
        tmp_path / "mine.yaml",
        lambda row: row | {"role": {"building": "person"}.get(row["name"], row["role"])},
    )
    settings, log = finished.settings.changed(f"classes={file}"), finished.drive().between("3:4")
    maps = [tiles.in_memory(finished.map())]
    write_moving_points({3: np.arange(0, 6000, 3)}, tmp_path / "moved.npz")
    [(_, [before])] = label_points(log, finished.trajectory, maps, settings)
    [(_, [found])] = label_points(log, finished.trajectory, maps, settings, [tmp_path / "moved.npz"])
    points = np.flatnonzero(found.removed)
    was, p_map = before.labels[points], small_drive.p_map[3][points]
    stays = np.isin(was, finished.label_set.having(Role.VEHICLE, Role.BUILDING))
    assert 100 < np.count_nonzero(stays) < len(points) - 100
    np.testing.assert_array_equal(found.labels[points[stays]], was[stays])
    np.testing.assert_array_equal(found.confidence[points[stays]], before.confidence[points[stays]])
    away = np.linalg.norm(p_map[~stays, None] - p_map[None, stays], axis=2)
    nearest, changed = away.min(axis=1), found.labels[points[~stays]]
    is_sure = (np.abs(nearest - 1) > 0.1) & (np.sort(away, axis=1)[:, 1] > nearest + 0.05)
    expected = np.where(nearest < 1, was[stays][away.argmin(axis=1)], finished.label_set.index("vehicle"))
    np.testing.assert_array_equal(changed[is_sure], expected[is_sure])
    assert len(np.unique(changed[is_sure])) == 2
    np.testing.assert_allclose(found.confidence[points[~stays]], 1 / 3)
