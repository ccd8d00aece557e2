"""Roles of classes: what the map asks of a class, whatever its name.

A class set gives a class one role, or none; where it gives no class a role, the names of `roles.yaml` do.
"""

from __future__ import annotations

from enum import StrEnum


class Role(StrEnum):
    """What a class is in a street."""

    ROAD = "road"
    """Ground that vehicles stand on."""
    SIDEWALK = "sidewalk"
    """Ground beside road, over a kerb."""
    VEHICLE = "vehicle"
    """Stands on or beside road, and may move."""
    PERSON = "person"
    """May move anywhere: pedestrians and cyclists."""
    BUILDING = "building"
    """Fills its columns from the ground up, and does not begin over level ground."""
    VEGETATION = "vegetation"
    """Over the ground, of any shape."""
    POLE = "pole"
    """Thin and upright."""


MOVABLE = (Role.VEHICLE, Role.PERSON)
"""Of what may move; what moved and is shown by no image is of the first."""
OF_ONE_CLASS = (Role.ROAD, Role.SIDEWALK, Role.BUILDING, Role.VEGETATION)
"""Those that are compared with each other: at most one class has each."""
