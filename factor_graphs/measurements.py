"""What the sensors said: IMU samples, GNSS fixes, wheel speeds, checked and frozen, and how raw rows become them.

A constructor refuses whatever is wrong. `clean_imu`, `clean_gnss` and `clean_wheels` take rows as a logger wrote
them, repair what has one obvious repair, and report every row that they dropped.
"""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.filled_gaps import filled_in
from factor_graphs.imu_noise import ImuNoise as ImuNoise
from factor_graphs.position_covariances import are_correlations, covariances_of
from factor_graphs.stamps import far_off, gaps

Array = NDArray[np.float64]

# No accelerometer or gyroscope says more, in whatever unit.
LARGEST_OF_IMU = 1e6
# Faster than this, m/s, and than so many usual speeds (in whatever unit), a wheel speed is a code for "not available";
# so is what is larger than the last, in any unit.
LARGEST_OF_WHEELS, LARGEST_OF_USUAL, LARGEST_OF_ANY = 150.0, 10.0, 1e6
# Standard deviation, m/s, of a component of velocity that is not measured: no vehicle is as fast.
UNMEASURED = 1e3
# Antennas nearer to each other than this show no heading.
LEAST_BASELINE_M = 0.05


@dataclass(frozen=True, eq=False)
class _Rows:
    """Arrays with a row for each stamp, frozen and checked: (n, 3), the `_flat` ones (n,), and the `_fixed` one (3,).

    Raises MeasurementError for another shape, a value that is not finite, stamps out of order, or stddevs, in `_unit`,
    that are not positive.
    """

    stamps: Array

    _flat: ClassVar[tuple[str, ...]] = ("stamps", "speeds", "azimuths")
    _fixed: ClassVar[str] = "baseline"
    _unit: ClassVar[str] = "m"

    def __post_init__(self) -> None:
        for f in fields(self):
            if (given := getattr(self, f.name)) is not None:
                array = np.array(given, dtype=np.float64)
                array.setflags(write=False)
                object.__setattr__(self, f.name, array)
        for f in fields(self):
            self._check(f.name, getattr(self, f.name))
        what, backwards = type(self).__name__, np.flatnonzero(np.diff(self.stamps) <= 0)
        if len(backwards):
            row = int(backwards[0])
            raise MeasurementError(
                f"{what}.stamps go from {self.stamps[row]} to {self.stamps[row + 1]} s at row {row + 1}; expected"
                " strictly increasing: sort and drop repeats with clean_imu/clean_gnss/clean_wheels"
            )
        stddevs = getattr(self, "stddevs", np.ones(1))
        if np.any(stddevs <= 0):
            row = int(np.argwhere(stddevs <= 0)[0, 0])
            raise MeasurementError(f"{what}.stddevs[{row}] is {stddevs[row]} {self._unit}; expected positive")

    def _check(self, name: str, array: Array | None) -> None:
        n = len(self.stamps) if self.stamps.ndim == 1 else -1
        expected = (3,) if name == self._fixed else (n,) if name in self._flat else (n, 3)
        what = f"{type(self).__name__}.{name}"
        if array is not None and array.shape != expected:
            raise MeasurementError(f"{what} has shape {array.shape}; expected {expected}")
        if array is not None and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise MeasurementError(f"{what}[{row}] is not finite; drop such rows with clean_imu, clean_gnss")

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name != self._fixed}
        return replace(self, **{name: array[rows] for name, array in given.items() if array is not None})


@dataclass(frozen=True, eq=False)
class ImuSamples(_Rows):
    """Specific force and angular rate in the imu frame (x forward, y left, z up), each value at its stamp.

    `stamps` (n,) s, strictly increasing; `specific_force` (n, 3) m/s²; `angular_rate` (n, 3) rad/s.
    Raises MeasurementError for another shape, for a value that is not finite, and for stamps out of order.
    """

    specific_force: Array
    angular_rate: Array

    def at_middle(self) -> "ImuSamples":
        """The same, each at the middle of the usual interval that ends at its stamp: of that it is the mean."""
        earlier = float(np.median(np.diff(self.stamps))) / 2
        return replace(self, stamps=self.stamps - earlier)


@dataclass(frozen=True, eq=False)
class GnssFixes(_Rows):
    """Antenna positions in the map frame with the receiver's own standard deviations.

    `stamps` (m,) s, strictly increasing; `positions` (m, 3) m; `stddevs` (m, 3) m, positive; `correlations` (m, 3) of
    the errors east-north, east-up and north-up, None: not correlated. No fix at all is a legal value. Raises
    MeasurementError as `ImuSamples` does, for a stddev that is not positive, and for correlations of no covariance.
    """

    positions: Array
    stddevs: Array
    correlations: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.correlations is not None and not (possible := are_correlations(self.correlations)).all():
            row = int(np.flatnonzero(~possible)[0])
            raise MeasurementError(
                f"GnssFixes.correlations[{row}] is {self.correlations[row]}; expected those of a positive definite"
                " covariance: make them with factor_graphs.position_covariances"
            )

    @cached_property
    def covariances(self) -> Array:
        """(m, 3, 3) m², of the errors east, north, up."""
        return covariances_of(self.stddevs, self.correlations)

    @cached_property
    def whitening(self) -> Array:
        """(m, 3, 3) 1/m: the matrices W that make unit noise of the errors, WᵀW being the inverse covariance."""
        if self.correlations is None:
            return np.eye(3) / self.stddevs[:, :, None]
        return np.linalg.inv(np.linalg.cholesky(self.covariances))


@dataclass(frozen=True, eq=False)
class WheelSpeeds(_Rows):
    """How fast the wheels roll, each value at its stamp: an odometer, or the speed on the vehicle's bus.

    `stamps` (n,) s, strictly increasing; `speeds` (n,) m/s, below zero in reverse if the sensor tells. No value at all
    is legal. Raises MeasurementError as `ImuSamples` does.
    """

    speeds: Array


@dataclass(frozen=True, eq=False)
class GnssVelocities(_Rows):
    """Velocity of the antenna in the map frame as a receiver measures it, by Doppler or by its filter.

    `stamps` (n,) s on the clock of the fixes, strictly increasing; `velocities` (n, 3) m/s; `stddevs` (n, 3) m/s,
    positive, and UNMEASURED for what is not measured: speed and course say nothing of up. Raises MeasurementError as
    `GnssFixes` does.
    """

    velocities: Array
    stddevs: Array

    _unit: ClassVar[str] = "m/s"


@dataclass(frozen=True, eq=False)
class AntennaHeadings(_Rows):
    """Azimuth of the baseline between two antennas of a receiver, clockwise from the map's north.

    `stamps` (n,) s on the clock of the fixes, strictly increasing; `azimuths` (n,) rad; `stddevs` (n,) rad, positive;
    `baseline` (3,) m, from the main antenna to the second one in the imu frame. Raises MeasurementError as `GnssFixes`
    does, and for a baseline that shows no heading: of two antennas that are one, or one above the other.
    """

    azimuths: Array
    stddevs: Array
    baseline: Array

    _flat: ClassVar[tuple[str, ...]] = ("stamps", "azimuths", "stddevs")
    _unit: ClassVar[str] = "rad"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (level := float(np.linalg.norm(self.baseline[:2]))) >= LEAST_BASELINE_M:
            raise MeasurementError(
                f"the two antennas are {level:.3f} m apart in the plane of the imu, expected {LEAST_BASELINE_M} m or"
                " more: p_imu_antenna2 is the place of the second antenna"
            )


@dataclass(frozen=True, eq=False)
class Repairs:
    """What cleaning did to the rows of one sensor: how many were dropped and why, and where data are missing.

    `gaps` (g, 2): first and last stamp, s, of every step by which more than one row is missing.
    """

    sensor: str
    rows: int
    not_finite: int = 0
    repeated: int = 0
    out_of_order: int = 0
    far_off: int = 0
    gaps: Array = field(default_factory=lambda: np.empty((0, 2)))
    absurd: int = 0
    filled_in: int = 0

    @property
    def dropped(self) -> int:
        """Number of rows that are not in the cleaned data."""
        return self.not_finite + self.repeated + self.far_off + self.absurd + self.filled_in

    def __str__(self) -> str:
        parts = [
            (self.not_finite, "not finite, dropped"),
            (self.repeated, "repeated, dropped"),
            (self.far_off, "with a stamp far off all others, dropped"),
            (self.absurd, "faster than any vehicle, dropped"),
            (self.filled_in, "on straight lines that fill gaps, dropped"),
            (self.out_of_order, "out of order, sorted"),
            (len(self.gaps), f"gaps, longest {np.ptp(self.gaps, axis=1).max(initial=0.0):.2f} s"),
        ]
        return f"{self.sensor}: {self.rows} rows" + "".join(f"; {n} {what}" for n, what in parts if n)


def clean_imu(
    stamps: ArrayLike, specific_force: ArrayLike, angular_rate: ArrayLike
) -> tuple[ImuSamples, Repairs]:
    """Raw IMU rows -> samples in order of time, once each, and the report of what was repaired.

    `stamps` (n,) s; `specific_force` (n, 3) m/s²; `angular_rate` (n, 3) rad/s. Rows that are not finite
    or beyond any sensor are dropped (GTSAM would integrate them), so is every row after the first with the same
    stamp, every row whose stamp is `far_off`, and what was `filled_in`. Raises MeasurementError for another shape and
    when fewer than two rows are left.
    """
    values = [np.asarray(c, dtype=np.float64) for c in (specific_force, angular_rate)]
    sensible = [np.where(np.abs(c) <= LARGEST_OF_IMU, c, np.nan) for c in values]
    columns, repairs = _clean("IMU", stamps, *sensible)
    if len(columns[0]) < 2:
        raise MeasurementError(f"{repairs}: {len(columns[0])} left, expected at least 2")
    samples = measured(ImuSamples(*columns))
    filled = len(columns[0]) - len(samples)
    return samples, replace(repairs, filled_in=filled, gaps=gaps(samples.stamps))


def measured(imu: ImuSamples) -> ImuSamples:
    """The samples without those that were `filled_in`."""
    filled = filled_in(imu.stamps, np.hstack([imu.specific_force, imu.angular_rate]))
    return imu[~filled] if filled.any() else imu


def clean_gnss(
    stamps: ArrayLike, positions: ArrayLike, stddevs: ArrayLike, correlations: ArrayLike | None = None
) -> tuple[GnssFixes, Repairs]:
    """Raw fixes -> fixes in order of time, once each, and the report of what was repaired.

    `stamps` (m,) s; `positions` (m, 3) m in the map frame; `stddevs` (m, 3) m; `correlations` (m, 3) as in `GnssFixes`,
    with NaN or zeros where they are not known. Raises MeasurementError as `GnssFixes` does.
    """
    given = [] if correlations is None else [np.nan_to_num(np.asarray(correlations, np.float64))]
    columns, repairs = _clean("GNSS", stamps, positions, stddevs, *given)
    return GnssFixes(*columns), repairs


def clean_wheels(stamps: ArrayLike, speeds: ArrayLike) -> tuple[WheelSpeeds, Repairs]:
    """Raw wheel speeds -> speeds in order of time, once each, and the report of what was repaired.

    `stamps` (n,) s; `speeds` (n,) m/s. Values beyond any vehicle are dropped: a bus has codes for "not available".
    Raises MeasurementError for another shape.
    """
    (cleaned, values), repairs = _clean("wheels", stamps, speeds, width=())
    size = np.abs(values)
    said = size[(size > 0) & (size <= LARGEST_OF_ANY)]
    usual = float(np.median(said)) if len(said) else 0.0
    sensible = size <= min(max(LARGEST_OF_WHEELS, LARGEST_OF_USUAL * usual), LARGEST_OF_ANY)
    kept = cleaned[sensible]
    repairs = replace(repairs, absurd=int(np.count_nonzero(~sensible)), gaps=gaps(kept))
    return WheelSpeeds(kept, values[sensible]), repairs


def clean_velocities(
    stamps: ArrayLike, velocities: ArrayLike, stddevs: ArrayLike
) -> tuple[GnssVelocities, Repairs]:
    """Raw GNSS velocities -> those in order of time, once each, and the report of what was repaired.

    Shapes and units as in `GnssVelocities`. An upward component without a value becomes one that is not measured; rows
    without east and north, or with a stddev of theirs that is not positive, are dropped. Raises MeasurementError for
    another shape.
    """
    v, s = (np.array(c, np.float64) for c in (velocities, stddevs))
    known = np.isfinite(v) & (s > 0) & (np.abs(v) < UNMEASURED)
    flat = ~known[..., 2]
    v[flat, 2], s[flat, 2], known[flat, 2] = 0.0, UNMEASURED, True
    v[~known.all(axis=-1)] = np.nan
    columns, repairs = _clean("GNSS velocity", stamps, v, s)
    return GnssVelocities(*columns), repairs


def clean_headings(
    stamps: ArrayLike, azimuths: ArrayLike, stddevs: ArrayLike, baseline: ArrayLike
) -> tuple[AntennaHeadings, Repairs]:
    """Raw headings -> those in order of time, once each, and the report of what was repaired.

    Shapes and units as in `AntennaHeadings`; rows with a stddev that is not positive are dropped. Raises
    MeasurementError as it does.
    """
    s = np.asarray(stddevs, np.float64)
    columns, repairs = _clean("antenna heading", stamps, azimuths, np.where(s > 0, s, np.nan), width=())
    return AntennaHeadings(columns[0], columns[1], columns[2], np.asarray(baseline, np.float64)), repairs


def _clean(
    sensor: str, stamps: ArrayLike, *vectors: ArrayLike, width: tuple[int, ...] = (3,)
) -> tuple[list[Array], Repairs]:
    columns = [np.asarray(c, dtype=np.float64) for c in (stamps, *vectors)]
    n = len(columns[0]) if columns[0].ndim == 1 else -1
    expected = [(n,), *[(n, *width)] * len(vectors)]
    if n < 0 or [c.shape for c in columns] != expected:
        shapes = ", ".join(str(("n", *shape[1:])).replace("'", "") for shape in expected)
        raise MeasurementError(f"{sensor} rows have shapes {[c.shape for c in columns]}; expected {shapes}")
    finite = np.logical_and.reduce(
        [np.isfinite(c.reshape(n, c.size // max(n, 1))).all(axis=1) for c in columns]
    )
    columns = [c[finite] for c in columns]
    off = far_off(columns[0])
    columns = [c[~off] for c in columns]
    out_of_order = int(np.count_nonzero(np.diff(columns[0]) < 0))
    _, first = np.unique(columns[0], return_index=True)
    repeated = len(columns[0]) - len(first)
    columns = [c[first] for c in columns]
    missing = int(n - np.count_nonzero(finite))
    return columns, Repairs(sensor, n, missing, repeated, out_of_order, int(off.sum()), gaps(columns[0]))
