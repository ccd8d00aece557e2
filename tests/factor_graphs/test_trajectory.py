import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory


def some(seed: int = 0, k: int = 9, velocities: bool = True, covariances: bool = True) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (k, 1, 1))
    T[:, :3, :3] = Rotation.random(k, random_state=seed).as_matrix()
    T[:, :3, 3] = rng.standard_normal((k, 3)) * 10
    root = rng.standard_normal((k, 6, 6))
    return Trajectory(
        np.cumsum(rng.uniform(0.05, 0.2, k)),
        T,
        rng.standard_normal((k, 3)) if velocities else None,
        root @ np.swapaxes(root, 1, 2) if covariances else None,
    )


@given(st.integers(0, 10**6), st.booleans())
def test_it_is_exact_at_its_knots(seed, velocities):
    t = some(seed, velocities=velocities)
    np.testing.assert_array_equal(t.at(t.stamps), t.T_map_imu)


@given(st.integers(0, 10**6), st.floats(0.01, 0.99))
def test_between_knots_rotation_is_slerp_and_position_a_line_without_velocities(seed, share):
    t = some(seed, k=2, velocities=False)
    stamp = t.start + share * (t.end - t.start)
    T = t.at(np.array([stamp]))[0]
    slerp = Slerp(t.stamps, Rotation.from_matrix(t.T_map_imu[:, :3, :3]))(stamp)
    np.testing.assert_allclose(T[:3, :3], slerp.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], (1 - share) * t.positions[0] + share * t.positions[1], atol=1e-9)


def test_a_cubic_motion_is_reproduced_exactly_where_velocities_are_known():
    stamps = np.array([0.0, 0.7, 1.0, 2.5])
    coefficients = np.random.default_rng(1).standard_normal((4, 3))

    def motion(s):
        return np.polynomial.polynomial.polyval(s, coefficients).T

    def velocity(s):
        return np.polynomial.polynomial.polyval(s, np.polynomial.polynomial.polyder(coefficients)).T

    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = motion(stamps)
    t = Trajectory(stamps, T, velocity(stamps))
    asked = np.linspace(0.0, 2.5, 101)
    np.testing.assert_allclose(t.at(asked)[:, :3, 3], motion(asked), atol=1e-12)


def test_beyond_its_ends_the_last_motion_goes_on_but_only_as_far_as_allowed():
    stamps = np.linspace(0.0, 1.0, 11)
    T = np.tile(np.eye(4), (11, 1, 1))
    T[:, :3, 3] = stamps[:, None] * [3.0, -1.0, 0.5]
    T[:, :3, :3] = Rotation.from_euler("z", stamps[:, None] * 0.4).as_matrix()
    for velocities in (None, np.tile([3.0, -1.0, 0.5], (11, 1))):
        t = Trajectory(stamps, T, velocities)
        beyond = t.at(np.array([-0.1, 1.1]), extrapolate_s=0.1)
        np.testing.assert_allclose(beyond[:, :3, 3], [[-0.3, 0.1, -0.05], [3.3, -1.1, 0.55]], atol=1e-12)
        yaw = Rotation.from_matrix(beyond[:, :3, :3]).as_euler("ZYX")[:, 0]
        np.testing.assert_allclose(yaw, [-0.04, 0.44], atol=1e-12)
        with pytest.raises(
            MeasurementError, match=r"-0\.100\.\.1\.100 s leave the trajectory 0\.000\.\.1\.000 s"
        ):
            t.at(np.array([-0.1, 1.1]), extrapolate_s=0.05)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("covariances", [True, False])
def test_what_is_saved_is_what_is_loaded(tmp_path, velocities, covariances):
    t = some(4, velocities=velocities, covariances=covariances)
    t.save(tmp_path / "trajectory.parquet")
    back = Trajectory.load(tmp_path / "trajectory.parquet")
    np.testing.assert_array_equal(back.stamps, t.stamps)
    np.testing.assert_array_equal(back.positions, t.positions)
    np.testing.assert_allclose(back.T_map_imu, t.T_map_imu, atol=1e-14)
    for name in ("velocities", "covariances"):
        given_value, loaded = getattr(t, name), getattr(back, name)
        assert (given_value is None) == (loaded is None)
        if given_value is not None:
            np.testing.assert_array_equal(loaded, given_value)


def test_the_file_says_its_units_and_frames(tmp_path):
    import pyarrow.parquet as pq

    some().save(tmp_path / "t.parquet")
    schema = pq.read_schema(tmp_path / "t.parquet")
    assert schema.names[:8] == ["stamp_s", "x", "y", "z", "qx", "qy", "qz", "qw"]
    assert len(schema.names) == 8 + 3 + 21
    assert b"imu" in schema.metadata[b"frame"]
    assert b"rad" in schema.metadata[b"covariance"]


def test_a_file_that_is_no_trajectory_is_refused(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pytest.raises(MeasurementError, match="no such file; expected a saved trajectory"):
        Trajectory.load(tmp_path / "nowhere.parquet")
    (tmp_path / "text.parquet").write_text("no")
    with pytest.raises(MeasurementError, match="not a Parquet file"):
        Trajectory.load(tmp_path / "text.parquet")
    pq.write_table(pa.table({"stamp_s": [0.0]}), tmp_path / "other.parquet")
    with pytest.raises(MeasurementError, match="no column x, y"):
        Trajectory.load(tmp_path / "other.parquet")
    pq.write_table(pa.table({"stamp_s": [0.0, 1.0], "x": [0.0, None]}), tmp_path / "gap.parquet")
    with pytest.raises(MeasurementError, match=r"found gaps in the columns \['x'\]"):
        Trajectory.load(tmp_path / "gap.parquet")


def test_position_stddevs_are_along_the_axes_of_the_map():
    T = np.eye(4)[None]
    T[0, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    covariance = np.diag([0, 0, 0, 4.0, 9.0, 1.0])[None]  # forward is north here
    t = Trajectory(np.zeros(1), T, None, covariance)
    np.testing.assert_allclose(t.position_stddevs, [[3.0, 2.0, 1.0]], atol=1e-12)


def test_wrong_shapes_and_stamps_are_refused():
    t = some()
    with pytest.raises(MeasurementError, match="T_map_imu has shape"):
        Trajectory(t.stamps, t.T_map_imu[:-1])
    with pytest.raises(MeasurementError, match="strictly increasing"):
        Trajectory(t.stamps[::-1], t.T_map_imu)
    with pytest.raises(MeasurementError, match="not empty"):
        Trajectory(np.empty(0), np.empty((0, 4, 4)))


@given(st.integers(0, 10**6), st.booleans(), st.booleans())
def test_in_another_frame_it_is_the_same_motion(seed, velocities, covariances):
    there = np.eye(4)
    there[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    there[:3, 3] = np.random.default_rng(seed).uniform(-1e4, 1e4, 3)
    t = some(seed, velocities=velocities, covariances=covariances)
    moved = t.moved(there)
    back = moved.moved(np.linalg.inv(there))
    np.testing.assert_array_equal(moved.stamps, t.stamps)
    np.testing.assert_allclose(back.T_map_imu, t.T_map_imu, atol=1e-10)
    between = np.linspace(t.start, t.end, 31)
    np.testing.assert_allclose(moved.at(between), there @ t.at(between), atol=1e-8)
    if velocities:
        np.testing.assert_allclose(moved.velocities, t.velocities @ there[:3, :3].T)
        np.testing.assert_allclose(back.velocities, t.velocities, atol=1e-12)
    else:
        assert moved.velocities is None
    if covariances:  # of the tangent in imu axes, which do not turn with the map
        np.testing.assert_array_equal(moved.covariances, t.covariances)
    else:
        assert moved.covariances is None


def test_a_part_of_it_goes_a_little_beyond_its_ends_and_is_never_empty():
    t = some(k=30)
    part = t.during(t.stamps[5] + 0.1, t.stamps[20] - 0.1)
    np.testing.assert_array_equal(part.T_map_imu, t[5:21].T_map_imu)
    np.testing.assert_array_equal(part.covariances, t[5:21].covariances)
    assert t.during(t.end + 1, t.end + 2) is t
