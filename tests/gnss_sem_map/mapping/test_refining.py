"""A map that changes in one place is refined again there, and nobody can tell it from one refined from scratch."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_street import BLOCKS, EVERY, FRAME, MOVED, SETTINGS, VOXELS, content, write_raw

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import evidence, refining
from gnss_sem_map.mapping.classifying import fit_classifiers
from gnss_sem_map.mapping.raw_map import open_raw, write_sum
from gnss_sem_map.mapping.refining import Refined, refine_map
from gnss_sem_map.voxels import reuse, tiles
from gnss_sem_map.voxels.blocks import Block
from gnss_sem_map.voxels.map_json import name_of
from gnss_sem_map.voxels.semantic_map import State
from gnss_sem_map.voxels.tile_files import TILE_BITS, Tile
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

WITHOUT_FREE_SPACE = SETTINGS.changed("refinement.free_space.enabled=false")
CLASSIFIED = Settings().changed("geometric_classifier.rows_per_fold=1000")


def seen_again(voxels: VoxelMap, tile: Tile) -> VoxelMap:
    """The same map with 40 voxels of a tile seen once more."""
    inside = (voxels.indices[:, :2] >> TILE_BITS == tile).all(axis=1)
    more = np.zeros(len(voxels), np.uint32)
    more[np.flatnonzero(inside)[1000:1040]] = 1
    return replace(
        voxels, hits=voxels.hits + more, evidence=voxels.evidence - 7 * more[:, None].astype(np.int32)
    )


@pytest.fixture
def refine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Refined, list[Block]]]:
    """Refine a run folder; also says which blocks were refined for it, in order."""

    def refined(
        run: Path, earlier: Path | None = None, settings: Settings = SETTINGS
    ) -> tuple[Refined, list[Block]]:
        called, original = [], refining.refine_block

        def watched(block: Block, *rest: Any) -> Any:
            called.append(block)
            return original(block, *rest)

        with monkeypatch.context() as patch:
            patch.setattr(refining, "refine_block", watched)
            found = refine_map(open_raw(run, open_label_set()), run, settings, earlier=earlier)
        return found, sorted(called)

    return refined


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street, refined; read only."""
    run = write_raw(tmp_path_factory.mktemp("street") / "run")
    refine_map(open_raw(run, open_label_set()), run, SETTINGS)
    return run


def linked(run: Path, earlier: Path, layer: str = "refined") -> list[Tile]:
    """The tiles of a layer that are files of an earlier run as well."""
    names = {tile: name_of(tile) for tile in EVERY}
    return [tile for tile in EVERY if (run / layer / names[tile]).samefile(earlier / layer / names[tile])]


def assert_as_from_scratch(
    run: Path, found: Refined, scratch: Path, refine: Callable[..., tuple[Refined, list[Block]]]
) -> None:
    """`scratch` holds the same raw map."""
    whole, called = refine(scratch)
    assert called == BLOCKS
    assert content(run / "refined") == content(scratch / "refined")
    assert found.report.to_json() == whole.report.to_json()


def tiles_in(blocks: list[Block]) -> list[Tile]:
    return [tile for block in blocks for tile in block]


@pytest.mark.parametrize(("changed", "near"), [((0, 0), BLOCKS[:2]), ((6, 0), BLOCKS[3:])])
def test_only_blocks_within_the_halo_of_a_change_are_refined_again(
    changed: Tile, near: list[Block], before: Path, tmp_path: Path, refine: Any
) -> None:
    voxels = seen_again(VOXELS, changed)
    found, called = refine(write_raw(tmp_path / "run", voxels), before)
    assert called == near
    assert linked(tmp_path / "run", before) == [tile for tile in EVERY if tile not in tiles_in(near)]
    assert_as_from_scratch(tmp_path / "run", found, write_raw(tmp_path / "scratch", voxels), refine)


def test_only_blocks_near_a_new_keyframe_scan_are_refined_again(
    before: Path, tmp_path: Path, refine: Any
) -> None:
    found, called = refine(write_raw(tmp_path / "run", scans=True), before)
    assert called == BLOCKS[1:3]
    assert linked(tmp_path / "run", before) == [*EVERY[:1], *EVERY[5:]]
    assert_as_from_scratch(tmp_path / "run", found, write_raw(tmp_path / "scratch", scans=True), refine)


def test_blocks_near_a_keyframe_scan_that_saw_something_else_are_refined_again(
    tmp_path: Path, refine: Any
) -> None:
    """Far away, where no voxel of theirs changes: its rays pass them all the same."""
    earlier, run = write_raw(tmp_path / "earlier", scans=True), write_raw(tmp_path / "run", scans=True)
    refine(earlier)
    file = run / "evidence/keyframes/0.npz"
    scans = evidence.read_keyframes(file)
    images = scans.images.copy()
    images[0][images[0] > 0] += 1000
    evidence.write_keyframes(replace(scans, images=images), file)
    found, called = refine(run, earlier)
    assert called == BLOCKS[1:3]
    scratch = write_raw(tmp_path / "scratch", scans=True)
    evidence.write_keyframes(replace(scans, images=images), scratch / "evidence/keyframes/0.npz")
    assert_as_from_scratch(run, found, scratch, refine)


def test_a_map_that_stays_is_not_refined_again(before: Path, tmp_path: Path, refine: Any) -> None:
    found, called = refine(write_raw(tmp_path / "run"), before)
    assert called == []
    assert linked(tmp_path / "run", before) == EVERY
    assert content(tmp_path / "run/refined") == content(before / "refined")
    assert found.kerbs is None
    assert_as_from_scratch(tmp_path / "run", found, write_raw(tmp_path / "scratch"), refine)


def test_other_settings_refine_every_block_again(before: Path, tmp_path: Path, refine: Any) -> None:
    _, called = refine(write_raw(tmp_path / "run"), before, WITHOUT_FREE_SPACE)
    assert called == BLOCKS
    assert linked(tmp_path / "run", before) == []


def copied(run: Path, to: Path) -> Path:
    """A run that a test may damage."""
    (to / "refined").mkdir(parents=True)
    for path in (run / "refined").iterdir():
        (to / "refined" / path.name).write_bytes(path.read_bytes())
    return to


def test_tiles_of_another_version_are_made_again(
    before: Path, tmp_path: Path, refine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reuse, "VERSION", "0.0.1")
    _, called = refine(write_raw(tmp_path / "run"), before)
    assert called == BLOCKS
    assert linked(tmp_path / "run", before) == []


@pytest.mark.parametrize("damaged", BLOCKS[2])
def test_a_block_with_a_damaged_tile_is_made_again(
    damaged: Tile, before: Path, tmp_path: Path, refine: Any
) -> None:
    earlier = copied(before, tmp_path / "earlier")
    tile = earlier / "refined" / name_of(damaged)
    content_of_tile = bytearray(tile.read_bytes())
    content_of_tile[1000] ^= 1
    tile.write_bytes(content_of_tile)
    _, called = refine(write_raw(tmp_path / "run"), earlier)
    assert called == [BLOCKS[2]]
    assert content(tmp_path / "run/refined") == content(before / "refined")


def without(said: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in said.items() if key != name}


@pytest.mark.parametrize(
    ("damage", "again"),
    [
        (lambda said: None, True),
        (lambda said: [said], True),
        (lambda said: without(said, "report"), True),
        (lambda said: said | {"report": {"steps": [{"name": "x"}]}}, True),
        (lambda said: said | {"report": [1]}, True),
        (lambda said: said | {"report": said["report"] | {"steps": []}}, True),
        (lambda said: said | {"report": said["report"] | {"steps": said["report"]["steps"][::-1]}}, True),
        (lambda said: said | {"report": said["report"] | {"systematic_errors": "x"}}, True),
        (lambda said: said | {"around": 3}, False),
        (lambda said: without(said, "sums"), False),
        (lambda said: said | {"sums": said["sums"] | {"roads": -1}}, False),
        (lambda said: said | {"sums": 5}, False),
        (lambda said: said | {"sums": "roads"}, False),
        (lambda said: said | {"sums": [said["sums"]]}, False),
    ],
)  # fmt: skip
def test_what_an_earlier_map_says_is_made_anew_where_it_cannot_be_read(
    damage: Callable[[dict[str, Any]], Any], again: bool, before: Path, tmp_path: Path, refine: Any
) -> None:
    """Without a report the block is refined again; without sums these are added up again."""
    earlier, damaged = copied(before, tmp_path / "earlier"), (3, 0)
    about = json.loads((earlier / "refined/map.json").read_text())
    of_tile = about["files"][name_of(damaged)]
    of_tile["said"] = damage(of_tile["said"])
    (earlier / "refined/map.json").write_text(json.dumps(about))
    _, called = refine(write_raw(tmp_path / "run"), earlier)
    assert called == ([BLOCKS[2]] if again else [])
    assert content(tmp_path / "run/refined") == content(before / "refined")


PART = VOXELS[np.flatnonzero(VOXELS.indices[:, 0] < 150)]
TOWNS: dict[str, tuple[list[Tile], list[Tile]]] = {
    "one": ([(2, 2)], []),
    "diagonal": ([(1, 2), (2, 1), (4, 1)], []),
    "three": ([(1, 2), (2, 1), (2, 2)], [(1, 2)]),
    "four": ([(1, 1), (1, 2), (2, 1), (2, 2), (3, 2)], [(1, 1)]),
}
"""Tiles with a part of the street, and those of them where all points moved."""


def town(run: Path, name: str) -> Path:
    """Parts of the street where four tiles meet, so that the same tiles are in different blocks."""
    tiles_of_town, moving = TOWNS[name]

    def part(tile: Tile) -> VoxelMap:
        x, y = (512 * axis + (at if axis % 2 else 5) for axis, at in zip(tile, (350, 495), strict=True))
        return replace(PART, keys=pack(PART.indices + np.array([x, y, 0])))

    moved = reduce(add, map(part, moving), PART[:0])
    return write_raw(run, reduce(add, map(part, tiles_of_town)), moved=moved)


@pytest.mark.parametrize("later", TOWNS)
@pytest.mark.parametrize("earlier", TOWNS)
def test_tiles_that_come_or_go_change_blocks_and_leave_no_trace(
    earlier: str, later: str, tmp_path: Path, refine: Any
) -> None:
    refine(town(tmp_path / "earlier", earlier))
    scratch, _ = refine(town(tmp_path / "scratch", later))
    found, called = refine(town(tmp_path / "run", later), tmp_path / "earlier")
    assert content(tmp_path / "run/refined") == content(tmp_path / "scratch/refined")
    assert found.report.to_json() == scratch.report.to_json()
    assert (called == []) == (earlier == later)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 1}'])
def test_an_earlier_map_that_cannot_be_read_is_as_none(
    text: str, before: Path, tmp_path: Path, refine: Any
) -> None:
    (tmp_path / "earlier/refined").mkdir(parents=True)
    (tmp_path / "earlier/refined/map.json").write_text(text)
    _, called = refine(write_raw(tmp_path / "run"), tmp_path / "earlier")
    assert called == BLOCKS
    assert content(tmp_path / "run/refined") == content(before / "refined")


def summed(run: Path, drives: list[Path], earlier: Path | None = None) -> dict[str, bytes]:
    run.mkdir()
    write_sum(drives, run, FRAME, earlier=earlier)
    return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_a_drive_that_comes_or_goes_changes_the_sum_in_its_tiles_only(tmp_path: Path) -> None:
    long, short, other = (
        write_raw(tmp_path / name, voxels, moved=moved)
        for name, voxels, moved in (
            ("long", VOXELS, MOVED),
            ("short", VOXELS[np.arange(9000)], MOVED[:0]),
            ("other", VOXELS[-9000:], MOVED[-500:]),
        )
    )
    two = summed(tmp_path / "two", [long, short])
    three = summed(tmp_path / "three", [long, other, short])
    assert summed(tmp_path / "added", [long, other, short], tmp_path / "two") == three
    assert summed(tmp_path / "removed", [long, short], tmp_path / "three") == two
    of_other = set(tiles.open_map(other / "map").tiles)
    assert 0 < len(of_other) < len(EVERY) - 1
    for later, earlier in (("added", "two"), ("removed", "three")):
        assert linked(tmp_path / later, tmp_path / earlier, "map") == [t for t in EVERY if t not in of_other]
    voxels = tiles.read(tmp_path / "three/map").voxels
    expected = VOXELS + VOXELS[np.arange(9000)] + VOXELS[-9000:]
    for name in ("keys", "evidence", "hits", "heights", "of_images"):
        np.testing.assert_array_equal(getattr(voxels, name), getattr(expected, name))


def test_drives_of_another_voxel_size_or_frame_do_not_add_up(tmp_path: Path) -> None:
    fine = write_raw(tmp_path / "fine")
    coarse = write_raw(
        tmp_path / "coarse", replace(VOXELS, voxel_size_m=0.4), moved=replace(MOVED, voxel_size_m=0.4)
    )
    elsewhere = write_raw(tmp_path / "elsewhere", frame=LocalFrame(49.0, 8.4, 112.0))
    for other in (coarse, elsewhere):
        with pytest.raises(DataError, match=r"voxels of .* m, or another frame; map them again$"):
            write_sum([fine, other], tmp_path / "out", FRAME)


def of_drives(run: Path, drives: dict[str, VoxelMap]) -> Path:
    """A map of several drives, each with its classifier."""
    folders = [write_raw(run / "drives" / name, voxels, moved=MOVED[:0]) for name, voxels in drives.items()]
    write_sum(folders, run, FRAME)
    assert fit_classifiers(run, CLASSIFIED) == []
    return run


@pytest.mark.integration  # scikit-learn asks the system for its cores
def test_a_classifier_changes_the_map_where_its_drive_is_and_nowhere_else(
    tmp_path: Path, refine: Any
) -> None:
    """A drive that comes, and then one that is classified otherwise, in two tiles at the end of the street."""
    long, short = VOXELS, VOXELS[-1200:]
    one = of_drives(tmp_path / "one", {"long": long})
    both, again = (of_drives(tmp_path / name, {"long": long, "short": short}) for name in ("both", "again"))
    assert refine(one, None, CLASSIFIED)[1] == BLOCKS
    inferred = tiles.read(one / "refined").states == State.INFERRED
    assert 0.05 * len(long) < np.count_nonzero(inferred) < 0.2 * len(long)
    found, called = refine(both, one, CLASSIFIED)
    assert called == BLOCKS[3:]
    whole, called = refine(again, None, CLASSIFIED)
    assert called == BLOCKS
    assert content(both / "refined") == content(again / "refined")
    assert found.report.to_json() == whole.report.to_json()


@pytest.mark.integration
def test_another_classifier_refines_every_block_of_its_drive_again(tmp_path: Path, refine: Any) -> None:
    run, again = (of_drives(tmp_path / name, {"short": VOXELS[-9000:]}) for name in ("run", "again"))
    weaker = CLASSIFIED.changed("geometric_classifier.kerb_weight=0.5")
    _, called = refine(run, None, CLASSIFIED)
    fit_classifiers(again, weaker)
    assert refine(again, run, weaker)[1] == called == BLOCKS[3:]
