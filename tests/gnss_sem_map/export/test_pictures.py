"""Pictures show what the map holds, where it is, for a courtyard as for a long drive."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.raster import top_view
from gnss_sem_map.export.render import Camera
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

NAMES = open_label_set().names


def strip(length_m: float) -> SemanticMap:
    """A road eastward with a hedge along its north side, 0.2 m voxels."""
    x = np.arange(round(length_m / 0.2))
    road = np.array([(i, j, 0) for i in x for j in range(20)])
    hedge = np.array([(i, j, k) for i in x for j in (20, 21) for k in range(3)])
    indices = np.concatenate([road, hedge])
    evidence = np.full((len(indices), len(NAMES)), -3000, np.int32)
    evidence[: len(road), NAMES.index("road")] = -10
    evidence[len(road) :, NAMES.index("vegetation")] = -10
    order = np.argsort(pack(indices))
    hits = np.ones(len(indices), np.uint32)
    return SemanticMap.of(VoxelMap(0.2, open_label_set(), pack(indices)[order], evidence[order], hits))


def near(image: np.ndarray, name: str, tolerance: float = 0.35) -> np.ndarray:
    """Where the image (h, w, 3) RGB shows a class: its colour, lighter or darker."""
    colour = open_label_set().colours[NAMES.index(name)].astype(float)
    colour /= np.linalg.norm(colour)
    norm = np.maximum(np.linalg.norm(image.astype(float), axis=2), 1e-9)
    return np.asarray((image @ colour / norm > 1 - 0.02 * tolerance) & (image.min(axis=2) < 200))


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image[..., ::-1]


@pytest.mark.parametrize("length_m", [40, 2000])
def test_north_is_up_and_the_hedge_lies_north_of_the_road(length_m: float, tmp_path: Path) -> None:
    write_topview(Exported(in_memory(strip(length_m)), title="a street"), tmp_path / "topview.png")
    image = read(tmp_path / "topview.png")
    height, width = image.shape[:2]
    assert 900 <= width <= 2000
    framed = image[: height - 90]  # without the legend
    road, hedge = (np.argwhere(near(framed, name)) for name in ("road", "vegetation"))
    assert len(road) > 2 * len(hedge) > 0
    assert hedge[:, 0].max() < road[:, 0].min()
    assert np.ptp(road[:, 1]) > 0.85 * width


def test_the_legend_names_the_classes_that_are_there_and_no_others(
    street: SemanticMap, tmp_path: Path
) -> None:
    write_topview(Exported(in_memory(street)), tmp_path / "street.png")
    write_topview(Exported(in_memory(strip(40))), tmp_path / "strip.png")
    swatches = [read(tmp_path / name)[-80:] for name in ("street.png", "strip.png")]
    legend = open_label_set().legend
    shown = [
        [name for name, c in zip(legend.names, legend.colours, strict=True) if (s == c).all(axis=2).any()]
        for s in swatches
    ]
    assert shown == [[*NAMES, "other"], ["road", "vegetation"]]


def test_what_is_inferred_is_lighter_and_nothing_else_changes(street: SemanticMap, tmp_path: Path) -> None:
    seen = replace(street, states=np.where(street.inferred, State.OBSERVED, street.states).astype(np.uint8))
    cells = top_view(Exported(in_memory(street)), 1800).inferred
    assert 0 < cells.sum() < cells.size
    for write, legend_px in ((write_topview, 122), (write_perspective, 64)):
        images = []
        for drawn in (seen, street):
            write(Exported(in_memory(drawn)), tmp_path / "picture.png")
            images.append(read(tmp_path / "picture.png")[:-legend_px].astype(int))
        changed = (images[0] != images[1]).any(axis=2)
        assert (images[1] >= images[0]).all()
        assert not (near(images[0], "road") & changed).any()
        if write is write_topview:
            assert changed.sum() == 6**2 * cells.sum()  # a cell of the view is so many pixels wide
        else:
            assert changed.sum() > 1000


def test_the_track_is_drawn_on_the_road_that_it_follows(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    write_topview(Exported(in_memory(street)), tmp_path / "without.png")
    write_topview(Exported(in_memory(street), [track]), tmp_path / "with.png")
    without, drawn = (read(tmp_path / name) for name in ("without.png", "with.png"))
    rows = len(without) - 100  # above the legend, which has one more entry
    without, drawn = without[:rows], drawn[:rows]
    changed = (without != drawn).any(axis=2)
    assert near(without, "road")[changed].mean() > 0.9
    assert changed.any(axis=0).sum() > 0.9 * without.shape[1]


def test_the_tracks_of_two_drives_are_drawn_as_the_two_halves_of_one(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    half = len(track) // 2
    halves = [
        Trajectory(track.stamps[part], track.T_map_imu[part]) for part in (slice(half + 1), slice(half, None))
    ]
    for name, tracks in (("whole", [track]), ("halves", halves)):
        write_perspective(Exported(in_memory(street), tracks), tmp_path / name, camera=chased((480, 270)))
    whole, drawn = (read(tmp_path / name).astype(int) for name in ("whole", "halves"))
    assert (np.abs(whole - drawn).max(axis=2) > 30).mean() < 0.002, "the beads of a half begin anew"


def test_the_removed_car_is_not_in_the_picture(street: SemanticMap, tmp_path: Path) -> None:
    write_topview(Exported(in_memory(street)), tmp_path / "topview.png")
    image = read(tmp_path / "topview.png")[:-100]
    columns = np.flatnonzero(near(image, "vehicle").any(axis=0))
    assert np.ptp(columns) < 0.1 * image.shape[1]


def test_an_empty_map_is_refused_in_one_line(street: SemanticMap, tmp_path: Path) -> None:
    empty = SemanticMap.of(street.voxels[np.zeros(len(street), bool)])
    with pytest.raises(DataError, match="no voxels to draw"):
        write_topview(Exported(in_memory(empty)), tmp_path / "topview.png")
    assert not list(tmp_path.iterdir())


def chased(size: tuple[int, int]) -> Camera:
    """Behind a car that drives east on the strip."""
    return Camera(np.array([-12.0, 2.0, 9.0]), np.array([30.0, 2.0, 0.0]), *size, 62.0)


def test_driving_east_the_hedge_in_the_north_is_on_the_left(tmp_path: Path) -> None:
    write_perspective(Exported(in_memory(strip(60))), tmp_path / "perspective.png", camera=chased((480, 270)))
    image = read(tmp_path / "perspective.png")[:270]
    road, hedge = (np.argwhere(near(image, name)) for name in ("road", "vegetation"))
    assert len(road) > 1000
    assert len(hedge) > 100
    lower = 200  # a row across both
    assert hedge[hedge[:, 0] == lower][:, 1].max() < road[road[:, 0] == lower][:, 1].min()
    assert not near(image[:30], "road").any()  # the sky


def test_the_default_camera_flies_behind_the_vehicle_and_sees_its_track(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    write_perspective(Exported(in_memory(street), [track]), tmp_path / "perspective.png")
    image = read(tmp_path / "perspective.png")
    assert image.shape[1] == 1920
    yellow = np.argwhere((image[:1080] > (200, 160, 0)).all(axis=2) & (image[:1080, :, 2] < 60))
    assert len(yellow) > 500
    assert abs(np.median(yellow[:, 1]) - 960) < 200
    assert near(image[:1080], "building")[:, :960].sum() > 10 * near(image[:1080], "building")[:, 960:].sum()


def test_without_a_trajectory_the_whole_map_is_in_the_picture(street: SemanticMap, tmp_path: Path) -> None:
    write_perspective(Exported(in_memory(street)), tmp_path / "perspective.png")
    image = read(tmp_path / "perspective.png")[:1080]
    drawn = np.argwhere(near(image, "road") | near(image, "sidewalk"))
    assert len(drawn) > 10_000
    assert (drawn.min(axis=0) > 0).all()
    assert (drawn.max(axis=0) < (1079, 1919)).all()
