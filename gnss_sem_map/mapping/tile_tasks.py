"""Work on blocks of tiles as tasks: neighbours share one, so workers start and halos are read once for several."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import TILES
from gnss_sem_map.process.execution import Executor, InProcess, Task, run_tasks
from gnss_sem_map.voxels.blocks import Block
from gnss_sem_map.voxels.map_json import name_of
from gnss_sem_map.voxels.reuse import Made, of_work
from gnss_sem_map.voxels.tile_files import Tile
from gnss_sem_map.voxels.tiles import z_order

VOXELS_PER_TASK = 1 << 18
"""About as many are in the blocks of a task: seconds of work, so workers end together, and progress is shown often."""


def on_blocks(
    function: str,
    shared: tuple[Any, ...],
    of_blocks: Mapping[Block, Any],
    voxels: Mapping[Tile, int],
    executor: Executor,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[tuple[Block, Any]]:
    """Call `function(*shared, [[block, of_block], ...])`, a list of results, for all blocks; yields each with its own.

    All arguments and results are JSON. `voxels` says how much work a tile is. A single task is done in this process.
    `progress(done, total)` counts tiles.
    """
    groups = _groups(list(of_blocks), voxels)
    tasks = [
        Task(f"tiles from {group[0][0]}", function, (*shared, [[block, of_blocks[block]] for block in group]))
        for group in groups
    ]
    done, group_of, total = 0, dict(zip(tasks, groups, strict=True)), sum(map(len, of_blocks))
    for task, results in run_tasks(tasks, executor if len(tasks) > 1 else InProcess()):
        done += sum(map(len, group_of[task]))
        progress(done, total)
        yield from zip(group_of[task], results, strict=True)


def block_of(tiles: Iterable[Iterable[int]]) -> Block:
    """A block that came with a task, where it is lists of JSON."""
    return tuple((x, y) for x, y in tiles)


def make_tiles(
    function: str,
    shared: tuple[Any, ...],
    of_blocks: Mapping[Block, dict[str, Any]],
    voxels: Mapping[Tile, int],
    executor: Executor,
    made_in: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[Tile, Made]:
    """The tiles that tasks saved in a folder, see `on_blocks`; `of_blocks` says what those of each are `made_from`.

    Raises DataError where one is not found.
    """
    for _ in on_blocks(function, shared, of_blocks, voxels, executor, progress):
        pass
    made_from = {tile: of_block["made_from"] for block, of_block in of_blocks.items() for tile in block}
    made = of_work(made_in, made_from)
    if lost := made_from.keys() - made.keys():
        raise DataError(
            f"{made_in}: {len(lost)} of {len(made_from)} tiles that were saved are not there, or damaged, such as"
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


def _groups(blocks: list[Block], voxels: Mapping[Tile, int]) -> list[list[Block]]:
    """Neighbouring blocks, of VOXELS_PER_TASK together, or one block that has more."""
    groups: list[list[Block]] = []
    room, begins = 0, {block[0]: block for block in blocks}
    for first in z_order(begins):
        block = begins[first]
        count = sum(voxels.get(tile, 0) for tile in block)
        if not groups or count > room:
            groups.append([])
            room = VOXELS_PER_TASK
        groups[-1].append(block)
        room -= count
    return groups
