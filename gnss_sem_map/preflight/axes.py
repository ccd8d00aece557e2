"""Mistakes in the axes of an IMU: every known one is tested, and the simplest one that explains the data is named.

A mistake says how to make the accelerometer's and the gyroscope's columns right. What was measured, the direction that
is up, the directions that answer to speeding up and to a bend to the left, and the sign of the turn, must then be
those of a right IMU.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.sensor_log.conventions import NAMED_AXES, matrix_of

Array = NDArray[np.float64]

# Directions that are nearer than this to an axis, rad, are that axis: half of a right angle.
NEAR_RAD = np.pi / 4
# A unit that is turned by half a right angle is called askew, though noise adds to it.
ASKEW_RAD = np.pi / 3
X, Y, Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Seen:
    """Directions in the accelerometer's axes, (3,) unit vectors or None where the drive does not show them."""

    up: Array
    """Direction of the specific force at rest."""
    ahead: Array | None
    left: Array | None
    turn: int
    """1: turns to the left are positive about `up`; -1: negative; 0: not seen."""
    rates: Array | None = None
    """(3, 3): what the gyroscope says of a turn about our x, y, z, as columns; NaN where it is not seen."""
    mirrored: bool | None = None
    """Whether the drive's own heading says that the track is mirrored; None: it says nothing."""


@dataclass(frozen=True, eq=False)
class AxesMistake:
    """A way to be wrong: `force` and `rate` (3, 3) make the columns right; `mirrored`: the track is, not the IMU."""

    name: str
    remedy: str
    force: Array
    rate: Array
    mirrored: bool = False

    def misfit(self, seen: Seen) -> float:
        """Largest angle, rad, between observed directions and those of a correct IMU; infinite for a wrong turn."""
        wanted = ((seen.up, Z), (seen.ahead, X), (seen.left, -Y if self.mirrored else Y))
        angles = [_angle(self.force @ d, w) for d, w in wanted if d is not None]
        # the turn was taken about what the accelerometer calls up, whatever axes the gyroscope has
        about_up = float(np.sign(np.round((self.rate @ seen.up)[2], 6))) * (-1 if self.mirrored else 1)
        if (seen.turn and about_up != seen.turn) or (seen.mirrored not in (None, self.mirrored)):
            return np.inf
        if seen.rates is not None:
            columns = zip((self.rate @ seen.rates).T, np.eye(3), strict=True)
            angles += [_angle(column, axis) for column, axis in columns if np.isfinite(column).all()]
        return max(angles)


RIGHT = AxesMistake("", "", np.eye(3), np.eye(3))


def probable(seen: Seen) -> tuple[AxesMistake, ...]:
    """The mistakes that explain what was seen, the usual before the odd; `RIGHT` alone where there need be none."""
    if RIGHT.misfit(seen) < ASKEW_RAD:
        return (RIGHT,)
    return next(
        (
            found
            for near in (NEAR_RAD, ASKEW_RAD)
            if (found := tuple(m for m in _KNOWN if m.misfit(seen) < near))
        ),
        (),
    )


def told_by_gravity_alone(seen: Seen, fitting: tuple[AxesMistake, ...]) -> tuple[AxesMistake, ...]:
    """The ways to mount a unit on its side that fit as well as the first of the mistakes; empty where it need not be.

    Without an answer to speeding up, bends or turns of another unit, gravity tells the axis that points up, no more.
    """
    first = fitting[0]
    is_on_its_side = abs(first.force[2, 2]) < 0.5 and np.array_equal(first.force, first.rate)
    if not is_on_its_side or any(known is not None for known in (seen.ahead, seen.left, seen.rates)):
        return ()
    return tuple(
        m for m in fitting if np.array_equal(m.force[2], first.force[2]) and np.array_equal(m.force, m.rate)
    )


def askew(seen: Seen, mistake: AxesMistake) -> tuple[float, float, float]:
    """Roll, pitch and yaw, deg, by which an IMU is turned besides the mistake, as far as it was seen."""
    pairs = [(seen.up, Z), (seen.ahead, X), (seen.left, -Y if mistake.mirrored else Y)]
    seen_of, wanted = zip(*[(mistake.force @ d, w) for d, w in pairs if d is not None], strict=True)
    rotation, _ = Rotation.align_vectors(
        np.array(wanted), np.array(seen_of), weights=[4.0, 2.0, 1.0][: len(wanted)]
    )
    yaw, pitch, roll = rotation.as_euler("ZYX", degrees=True)
    return float(roll), float(pitch), float(yaw if len(wanted) > 1 else 0.0)


def _known() -> Iterator[AxesMistake]:
    """Known mistakes, the common ones first."""
    yield RIGHT
    yield _of_axes("frd")
    flipped, same = -np.eye(3), np.eye(3)
    yield AxesMistake(
        "gravity is flipped: at rest the force points down, as if the accelerometer reported gravity",
        'set force_axes: "-x -y -z"',
        flipped,
        same,
    )
    yield AxesMistake(
        "the track is mirrored: latitude and longitude are swapped (or the IMU's y points right alone)",
        "swap the columns lat_deg and lon_deg",
        same,
        same,
        mirrored=True,
    )
    yield AxesMistake(
        "the gyroscope turns the wrong way: its signs are reversed",
        'set rate_axes: "-x -y -z"',
        same,
        flipped,
    )
    for axes in _rotations():
        yield _of_axes(axes)
    for k, axis in enumerate("xyz"):
        signs = np.ones(3)
        signs[k] = -1
        words = " ".join(("-" if other == axis else "") + other for other in "xyz")
        for rate, column in ((same, ""), (np.diag(signs), " and of the rate")):
            key = "imu_axes" if column else "force_axes"
            yield AxesMistake(
                f"{axis} of the force{column} is reversed alone: {axis} points backwards",
                f'set {key}: "{words}"',
                np.diag(signs),
                rate,
            )
    for axes in _rotations():
        yield AxesMistake(
            f"gravity is flipped, and {_described(matrix_of(axes))}",
            f'set imu_axes: "{axes}" and force_axes: "{axes_of(-matrix_of(axes))}"',
            -matrix_of(axes),
            matrix_of(axes),
        )


def _rotations() -> Iterator[str]:
    """The other 22 right-handed ways to mount, those with z upright first."""
    named = {NAMED_AXES["flu"], NAMED_AXES["frd"]}
    ways = [
        " ".join(sign + letter for sign, letter in zip(signs, letters, strict=True))
        for letters in permutations("xyz")
        for signs in product(("", "-"), repeat=3)
    ]
    proper = [axes for axes in ways if np.linalg.det(matrix_of(axes)) > 0 and axes not in named]
    yield from sorted(proper, key=lambda axes: (-abs(matrix_of(axes)[2, 2]), -matrix_of(axes)[2, 2]))


def _of_axes(axes: str) -> AxesMistake:
    matrix = matrix_of(axes)
    words = f"set imu_axes: {axes}" if axes in NAMED_AXES else f'set imu_axes: "{axes}"'
    return AxesMistake(_described(matrix), words, matrix, matrix)


def _described(matrix: Array) -> str:
    """How a unit sits whose columns `matrix` (3, 3) makes right."""
    if np.array_equal(matrix, matrix_of("frd")):
        return "z points down: FRD axes (forward, right, down)"
    if np.array_equal(matrix, matrix_of("rfu")):
        return "turned by 90° about z: RFU axes (x right, y forward)"
    yaw = round(float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0]))))
    if matrix[2, 2] > 0:
        ahead = {
            180: "x points backwards, or all of the drive is in reverse (then run with --force)",
            -180: "x points backwards, or all of the drive is in reverse (then run with --force)",
            90: "x points left",
            -90: "x points right",
        }
        return f"the IMU is turned by {abs(yaw)}° about z: {ahead[yaw]}"
    directions = [_direction(column) for column in matrix.T]
    upside_down = "upside down: " if matrix[2, 2] < 0 else "on its side: "
    return f"the IMU is mounted {upside_down}x points {directions[0]}, y {directions[1]}, z {directions[2]}"


def _direction(column: Array) -> str:
    names = (("forward", "backwards"), ("left", "right"), ("up", "down"))
    k = int(np.argmax(np.abs(column)))
    return names[k][int(column[k] < 0)]


def axes_of(matrix: Array) -> str:
    """The setting that a signed permutation (3, 3) is."""
    words = []
    for row in matrix:
        k = int(np.argmax(np.abs(row)))
        words.append(("-" if row[k] < 0 else "") + "xyz"[k])
    return " ".join(words)


def _angle(a: Array, b: Array) -> float:
    return float(np.arccos(np.clip(a @ b / max(float(np.linalg.norm(a)), 1e-12), -1.0, 1.0)))


_KNOWN = tuple(_known())
USUAL = _KNOWN[:5]
