"""Work on the tiles of a map as tasks: neighbours share one, so workers start and halos are read once for several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import TILES
from gnss_sem_map.mapping.execution import Executor, InProcess, Task, run_tasks
from gnss_sem_map.voxels.map_json import name_of
from gnss_sem_map.voxels.reuse import Made, of_work
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import z_order

VOXELS_PER_TASK = 1 << 18
"""About as many are in the tiles of one task: seconds of work, so workers end together, and progress is shown often."""


def on_tiles(
    function: str,
    shared: tuple[Any, ...],
    of_tiles: Mapping[Tile, Any],
    voxels: Mapping[Tile, int],
    executor: Executor,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[tuple[Tile, Any]]:
    """Call `function(*shared, [[x, y, of_tile], ...])`, a list of results, for all tiles; yields each with its result.

    All arguments and results are JSON. `voxels` says how much work a tile is. A single task is done in this process.
    `progress(done, total)` counts tiles.
    """
    groups = _groups(list(of_tiles), voxels)
    tasks = [
        Task(f"tiles from {group[0]}", function, (*shared, [[*tile, of_tiles[tile]] for tile in group]))
        for group in groups
    ]
    done, group_of = 0, dict(zip(tasks, groups, strict=True))
    for task, results in run_tasks(tasks, executor if len(tasks) > 1 else InProcess()):
        done += len(group_of[task])
        progress(done, len(of_tiles))
        yield from zip(group_of[task], results, strict=True)


def make_tiles(
    function: str,
    shared: tuple[Any, ...],
    of_tiles: Mapping[Tile, dict[str, Any]],
    voxels: Mapping[Tile, int],
    executor: Executor,
    made_in: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[Tile, Made]:
    """The tiles that tasks saved in a folder, see `on_tiles`; `of_tiles` says what each is `made_from`.

    Raises DataError where one is not found.
    """
    for _ in on_tiles(function, shared, of_tiles, voxels, executor, progress):
        pass
    made = of_work(made_in, {tile: of_tile["made_from"] for tile, of_tile in of_tiles.items()})
    if lost := of_tiles.keys() - made.keys():
        raise DataError(
            f"{made_in}: {len(lost)} of {len(of_tiles)} tiles that were saved are not there, or damaged, such as"
            f" {name_of(min(lost))}; do all workers see this folder?"
        )
    return made


@contextmanager
def folder_of_tiles(work: Path | None, run: Path, name: str) -> Iterator[Path]:
    """Where tasks put the tiles of a map: in the work folder, or else in a folder of the run that is removed again.

    Raises DataError.
    """
    try:
        if work is None:
            with TemporaryDirectory(prefix=f".{name}.", dir=run) as folder:
                yield Path(folder)
        else:
            (work / TILES / name).mkdir(parents=True, exist_ok=True)
            yield work / TILES / name
    except OSError as error:
        raise DataError(
            f"{run}: cannot write tiles ({error.strerror}); free the disk or choose another place"
        ) from None


def _groups(tiles: list[Tile], voxels: Mapping[Tile, int]) -> list[list[Tile]]:
    """Neighbouring tiles, of VOXELS_PER_TASK together, or of one tile that has more."""
    groups: list[list[Tile]] = []
    room = 0
    for tile in z_order(tiles):
        count = voxels.get(tile, 0)
        if not groups or count > room:
            groups.append([])
            room = VOXELS_PER_TASK
        groups[-1].append(tile)
        room -= count
    return groups
