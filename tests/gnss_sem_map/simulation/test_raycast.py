"""Rays meet the surfaces that the town is made of, where these are, and nothing before. The oracle is plain numpy."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.simulation import Simulation, World, build_town
from gnss_sem_map.simulation.ground import FAR, Ground, height_gradient, hit_ground
from gnss_sem_map.simulation.kitti_rig import T_IMU_LIDAR
from gnss_sem_map.simulation.raycast import GROUND, KERB, cast_ray, hit_thing
from gnss_sem_map.simulation.shapes import Form, hit_shape
from gnss_sem_map.simulation.surfaces import Kind, Surface

Floats = npt.NDArray[np.float64]


def town_coordinates(ground: Ground, p: Floats) -> Floats:
    """(k, 2) u, v of map points."""
    c, s = ground.heading
    d = p[:, :2] - np.array(ground.origin)
    return np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]])


def sheet_height(ground: Ground, p: Floats) -> Floats:
    """Height of the streets' sheet below map points, (k,)."""
    xx, xy, yy = ground.curvature
    x, y = p[:, 0], p[:, 1]
    return ground.slope[0] * x + ground.slope[1] * y + 0.5 * (xx * x * x + 2 * xy * x * y + yy * y * y)


def kerb_distance(ground: Ground, p: Floats) -> Floats:
    """Signed distance to the nearest kerb, positive on a block: a block is a rounded rectangle."""
    uv, r = town_coordinates(ground, p), ground.corner_radius
    q = np.empty_like(uv)  # beyond the straight part of the nearest block's sides
    for axis, streets in enumerate((ground.streets_u, ground.streets_v)):
        low = np.concatenate([[-5000.0], streets[:, 0] + streets[:, 1]])
        high = np.concatenate([streets[:, 0] - streets[:, 1], [5000.0]])
        beyond = np.abs(uv[:, axis, None] - 0.5 * (low + high)) - (0.5 * (high - low) - r)
        q[:, axis] = beyond.min(axis=1)  # blocks stand in rows: the nearest is so along both axes
    out = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - r
    return -out


def shape_gap(shape: Floats, p: Floats) -> Floats:
    """How far points (k, 3) of a model's axes are from a shape's surface along the worst of its sides; 0 on it.

    For blocks the largest of six planes' signed distances; for round shapes the implicit equation, to first order.
    """
    q, half = p - shape[:3], shape[3:6]
    up = 0.5 * (q[:, 2] / half[2] + 1.0)
    if shape[11] == Form.BLOCK:
        sides = [
            q[:, 2] - half[2], -q[:, 2] - half[2],
            q[:, 0] - half[0] + shape[6] * up, -q[:, 0] - half[0] + shape[7] * up,
            q[:, 1] - half[1] + shape[8] * up, -q[:, 1] - half[1] + shape[8] * up,
        ]  # fmt: skip
        return np.max(sides, axis=0)
    scaled = q / half
    if shape[11] == Form.ELLIPSOID:
        length = np.linalg.norm(scaled, axis=1)
        return (length - 1.0) * half.min()
    round_axes, straight = ([0, 1], 2) if shape[11] == Form.UPRIGHT else ([0, 2], 1)
    tube = (np.linalg.norm(scaled[:, round_axes], axis=1) - 1.0) * half[0]
    return np.maximum(tube, np.abs(q[:, straight]) - half[straight])


def into_model(place: Floats, p: Floats) -> Floats:
    """Map points in the axes of a thing at x, y, z, yaw, shear along, shear across."""
    c, s = np.cos(place[3]), np.sin(place[3])
    d = p - place[:3]
    x, y = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    return np.column_stack([x, y, d[:, 2] - place[4] * x - place[5] * y])


def some_shape(form: Form, surface: Surface = Surface.STONE) -> Floats:
    """A shape of 4 by 2 by 1.6 m around (0.3, -0.2, 0.1); blocks taper."""
    tapers = [0.7, 0.3, 0.25] if form == Form.BLOCK else [0.0, 0.0, 0.0]
    half = (
        [0.8, 0.8, 1.0] if form == Form.UPRIGHT else [0.8, 1.0, 0.8] if form == Form.AXLE else [2.0, 1.0, 0.8]
    )
    row = [0.3, -0.2, 0.1, *half, *tapers, 0.5, 0.3, form, surface, Kind.BUILDING]
    return np.array([[*row, float(np.linalg.norm(half))]])


@pytest.fixture(scope="module")
def ground() -> Ground:
    return build_town(0).ground


@pytest.fixture(scope="module")
def rays() -> tuple[Floats, Floats]:
    """2000 rays from 6 m around the origin towards it."""
    rng = np.random.default_rng(3)
    start = rng.standard_normal((2000, 3))
    start *= 6.0 / np.linalg.norm(start, axis=1)[:, None]
    along = rng.uniform(-1.2, 1.2, (2000, 3)) - start
    return start, along / np.linalg.norm(along, axis=1)[:, None]


@pytest.mark.parametrize("form", list(Form))
def test_a_ray_stops_on_the_surface_and_not_before(form: Form, rays: tuple[Floats, Floats]) -> None:
    shape = some_shape(form)
    hits = 0
    for o, d in zip(*rays, strict=True):
        t = hit_shape(shape, 0, 1, FAR, *o, *d)
        on_the_way = o + np.linspace(0.0, min(t, 14.0), 200)[:-1, None] * d
        assert shape_gap(shape[0], on_the_way).min() > -1e-9
        if t < FAR:
            hits += 1
            assert shape_gap(shape[0], (o + t * d)[None])[0] == pytest.approx(0.0, abs=1e-9)
    assert hits > 500


def test_leaves_hang_inside_their_crown_and_let_some_rays_through(rays: tuple[Floats, Floats]) -> None:
    crown = some_shape(Form.ELLIPSOID, Surface.LEAVES)
    solid = some_shape(Form.ELLIPSOID)
    through = 0
    for o, d in zip(*rays, strict=True):
        t, shell = hit_shape(crown, 0, 7, FAR, *o, *d), hit_shape(solid, 0, 7, FAR, *o, *d)
        assert t >= shell
        if t < FAR:
            assert shape_gap(solid[0], (o + t * d)[None])[0] < 0.0
        through += shell < FAR <= t
    assert 20 < through < 1000


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(st.floats(-120, 120), st.floats(-120, 120)),
    st.floats(0.5, 8.0),
    st.floats(-3.2, 3.2),
    st.floats(-1.2, -0.03),
)
def test_the_ground_is_met_once_and_at_its_height(
    ground: Ground, at: tuple[float, float], above: float, course: float, down: float
) -> None:
    spot = np.array([[*at, 0.0]])
    o = np.array([*at, sheet_height(ground, spot)[0] + ground.kerb_height + above])
    d = np.array([np.cos(course) * np.cos(down), np.sin(course) * np.cos(down), np.sin(down)])
    t, kerb = hit_ground(ground, FAR, *o, *d)
    if t > 300.0:
        return
    hit = (o + t * d)[None]
    level, inside = hit[0, 2] - sheet_height(ground, hit)[0], kerb_distance(ground, hit)[0]
    if kerb:
        assert abs(inside) < 2e-4
        assert -1e-9 <= level <= ground.kerb_height + 1e-9
    else:
        assert level == pytest.approx(ground.kerb_height if inside > 0 else 0.0, abs=1e-7)
    way = o + np.linspace(0.0, t, 3000)[:-1, None] * d
    clear = (
        way[:, 2]
        - sheet_height(ground, way)
        - np.where(kerb_distance(ground, way) > 2e-3, ground.kerb_height, 0.0)
    )
    assert clear.min() > -1e-6


@pytest.mark.slow
def test_the_grid_forgets_nothing(whole_drive: Simulation) -> None:
    world = whole_drive.world
    scene = world.scene(12.0, 12.1)
    rng = np.random.default_rng(5)
    o = world.ego.poses([12.05])[0, :3, 3]
    for _ in range(400):
        course, up, late = rng.uniform(-np.pi, np.pi), rng.uniform(-0.3, 0.25), rng.uniform(0, 1)
        d = np.array([np.cos(course) * np.cos(up), np.sin(course) * np.cos(up), np.sin(up)])
        t, thing, shape = cast_ray(scene, 120.0, False, late, *o, *d)
        best, kerb = hit_ground(scene.ground, FAR, *o, *d)
        expected = (min(best, FAR), KERB if kerb else GROUND, -1) if best < 120.0 else (FAR, GROUND, -1)
        best = min(best, 120.0)
        for k in range(len(scene.things)):
            closer, which = hit_thing(scene.things, scene.shapes, k, best, late, *o, *d)
            if which >= 0:
                best, expected = closer, (closer, k, which)
        assert (t, thing, shape) == expected


def test_a_shadow_ray_agrees_with_a_full_one(whole_drive: Simulation) -> None:
    scene = whole_drive.world.scene(3.0, 3.0)
    rng = np.random.default_rng(6)
    for _ in range(300):
        o = whole_drive.world.ego.poses([3.0])[0, :3, 3] + np.array([*rng.uniform(-15, 15, 2), 0.5])
        d = np.array([0.5, 0.3, 0.8124])
        shadow = cast_ray(scene, 70.0, True, 0.5, *o, *d)
        full = cast_ray(scene, 70.0, False, 0.5, *o, *d)
        assert (shadow[0] < FAR) == (full[1] >= 0)


def map_points(simulation: Simulation, frame: int) -> tuple[Floats, npt.NDArray[np.uint32]]:
    """A scan's points in the map, each from where the LiDAR was at the point's own stamp; and their labels."""
    scan = simulation.scan(frame)
    start, end = simulation.sweeps[frame]
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(float)
    stamps = start + (0.5 - azimuth / (2 * np.pi)) * (end - start)  # what a reader of the file would do
    T = simulation.world.ego.poses(stamps) @ T_IMU_LIDAR
    p = scan.points[:, :3].astype(float)
    return np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3], scan.labels


@pytest.mark.parametrize("frame", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (80, 165, 240))])
def test_points_at_their_own_stamps_lie_on_ground_and_vehicles(whole_drive: Simulation, frame: int) -> None:
    points, labels = map_points(whole_drive, frame)
    ground, raw, instances = whole_drive.world.town.ground, labels & 0xFFFF, labels >> 16
    level, inside = points[:, 2] - sheet_height(ground, points), kerb_distance(ground, points)
    road = np.isin(raw, [40, 60])
    assert np.abs(level[road]).max() < 0.003
    flat = (raw == 48) & (inside > 0.01)
    assert np.abs(level[flat] - ground.kerb_height).max() < 0.003
    assert road.sum() > 1000
    world: World = whole_drive.world
    seen = 0
    for number in np.unique(instances[raw == 10]):
        thing = world.town.things[int(np.flatnonzero(world.instances == number)[0])]
        p = into_model(world.town.place(thing), points[instances == number])
        gaps = np.abs([shape_gap(shape, p) for shape in world.town.models[thing.model].shapes]).min(axis=0)
        assert gaps.max() < 0.004
        seen += len(p)
    assert seen > 40


@pytest.mark.parametrize(
    "frame", [30, pytest.param(140, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.slow)]
)
def test_points_on_movers_lie_where_these_are_at_the_ray_s_own_time(
    whole_drive: Simulation, frame: int
) -> None:
    scan, world = whole_drive.scan(frame), whole_drive.world
    points, labels = map_points(whole_drive, frame)
    start, end = whole_drive.sweeps[frame]
    stamps = start + scan.fractions * (end - start)
    seen = 0
    for k, mover in enumerate(world.movers):
        mine = labels >> 16 == world.instances[len(world.town.things) + k]
        if not mine.any():
            continue
        T = mover.motion.poses(stamps[mine])
        yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
        slope = np.array([height_gradient(world.town.ground, x, y) for x, y in T[:, :2, 3]])
        c, s = np.cos(yaw), np.sin(yaw)
        shear = np.column_stack([c * slope[:, 0] + s * slope[:, 1], c * slope[:, 1] - s * slope[:, 0]])
        places = np.column_stack([T[:, :3, 3], yaw, shear])
        local = np.concatenate(
            [into_model(place, p[None]) for place, p in zip(places, points[mine], strict=True)]
        )
        gaps = np.abs([shape_gap(shape, local) for shape in world.town.models[mover.model].shapes]).min(
            axis=0
        )
        assert gaps.max() < 0.012  # a mover goes steadily during a sweep: up to 4 mm from braking
        seen += int(mine.sum())
    assert seen > 100


def test_range_noise_has_the_size_it_says(simulation: Simulation) -> None:
    points, labels = map_points(simulation, 5)
    road = np.isin(labels & 0xFFFF, [40, 60])
    origin = (simulation.world.ego.poses([simulation.stamps[5]])[0] @ T_IMU_LIDAR)[:3, 3]
    ray = points[road] - origin
    slant = np.abs(ray[:, 2]) / np.linalg.norm(ray, axis=1)
    level = points[road, 2] - sheet_height(simulation.world.town.ground, points[road])
    assert np.std(level / slant) == pytest.approx(0.02, rel=0.1)
