"""Materials of the town: surfaces (appearance and reflectance) and classes.

A shape carries one of each: a wheel's rubber looks the same on a car and on a truck, and means another class.
"""

from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt


class Surface(IntEnum):
    """Surface: determines the colour in the image and the reflectance for the LiDAR."""

    ASPHALT = 0
    MARKING = 1
    PAVING = 2
    KERB = 3
    PARKING = 4
    GRASS = 5
    FACADE = 6
    ROOF = 7
    STONE = 8
    WALL = 9
    FENCE = 10
    LEAVES = 11
    BARK = 12
    STEEL = 13
    SIGN = 14
    LIGHT = 15
    PAINT = 16
    CABIN = 17
    RUBBER = 18
    HEADLAMP = 19
    TAILLAMP = 20
    CLOTH = 21
    SKIN = 22
    CARGO = 23
    SKY = 24


class Kind(IntEnum):
    """Kind of a thing."""

    NOTHING = 0
    ROAD = 1
    MARKING = 2
    SIDEWALK = 3
    PARKING = 4
    TERRAIN = 5
    BUILDING = 6
    WALL = 7
    FENCE = 8
    FOLIAGE = 9
    TRUNK = 10
    POLE = 11
    SIGN = 12
    LIGHT = 13
    CAR = 14
    TRUCK = 15
    PERSON = 16
    CYCLIST = 17
    CONTAINER = 18


# kind -> (SemanticKITTI id at rest, the same when moving, Cityscapes trainId)
_CODES: Final = {
    Kind.NOTHING: (0, 0, 10),
    Kind.ROAD: (40, 40, 0),
    Kind.MARKING: (60, 60, 0),
    Kind.SIDEWALK: (48, 48, 1),
    Kind.PARKING: (44, 44, 255),
    Kind.TERRAIN: (72, 72, 9),
    Kind.BUILDING: (50, 50, 2),
    Kind.WALL: (51, 51, 3),
    Kind.FENCE: (51, 51, 4),
    Kind.FOLIAGE: (70, 70, 8),
    Kind.TRUNK: (71, 71, 8),
    Kind.POLE: (80, 80, 5),
    Kind.SIGN: (81, 81, 7),
    Kind.LIGHT: (99, 99, 6),
    Kind.CAR: (10, 252, 13),
    Kind.TRUCK: (18, 258, 14),
    Kind.PERSON: (30, 254, 11),
    Kind.CYCLIST: (31, 253, 12),
    Kind.CONTAINER: (99, 99, 255),
}

RAW_IDS: Final[npt.NDArray[np.uint32]] = np.array([_CODES[kind][:2] for kind in Kind], np.uint32).T.copy()
"""(2, kinds): the SemanticKITTI id of a kind at rest and moving."""

TRAIN_IDS: Final[npt.NDArray[np.uint8]] = np.array([_CODES[kind][2] for kind in Kind], np.uint8)
"""(kinds,): the Cityscapes trainId of a kind; nothing is sky, parking and containers are void as in Cityscapes."""

# Reflectance at normal incidence; painted signs and lamps are retro-reflectors.
_REFLECTANCES: Final = {
    Surface.ASPHALT: 0.24,
    Surface.MARKING: 0.62,
    Surface.PAVING: 0.36,
    Surface.KERB: 0.42,
    Surface.PARKING: 0.30,
    Surface.GRASS: 0.46,
    Surface.FACADE: 0.44,
    Surface.ROOF: 0.30,
    Surface.STONE: 0.40,
    Surface.WALL: 0.38,
    Surface.FENCE: 0.34,
    Surface.LEAVES: 0.42,
    Surface.BARK: 0.30,
    Surface.STEEL: 0.34,
    Surface.SIGN: 0.98,
    Surface.LIGHT: 0.20,
    Surface.PAINT: 0.34,
    Surface.CABIN: 0.08,
    Surface.RUBBER: 0.06,
    Surface.HEADLAMP: 0.90,
    Surface.TAILLAMP: 0.95,
    Surface.CLOTH: 0.36,
    Surface.SKIN: 0.40,
    Surface.CARGO: 0.45,
    Surface.SKY: 0.0,
}
REFLECTANCES: Final[npt.NDArray[np.float64]] = np.array([_REFLECTANCES[surface] for surface in Surface])
