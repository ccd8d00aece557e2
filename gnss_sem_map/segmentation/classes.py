"""Class names of the channels of a network: given by the user, its own, or derived from their number."""

from __future__ import annotations

import re
from collections.abc import Sequence

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels.label_set import OTHER, LabelSet, taxonomy

VOID = "void"
"""A channel of this name has no class: it is dropped, before the softmax where we compute that."""

BY_COUNT = {6: "kitti6", 11: "camvid", 19: "cityscapes", 65: "mapillary", 150: "ade20k"}
"""Published street networks with that many classes have these, in the order of their ids."""

NUMBERED = re.compile(r"(label|class|id)?[ _-]*\d+", re.IGNORECASE)
"""What stands for a name where nobody gave one."""


def named_classes(
    description: str | None,
    count: int | None,
    label_set: LabelSet,
    where: str,
    own: Sequence[str] | None = None,
) -> tuple[str, ...]:
    """The names of `count` channels, from a list of class and taxonomy names joined by commas.

    A taxonomy stands for its classes in the order of its first kind of ids. Without a description they have their
    `own` names, and without those the count decides (BY_COUNT). Without `count`, the description tells it. Several may
    have one name. Raises ConfigError for another number of names, for a described name that the class set does not
    know, and where it knows none of their own.
    """
    usual = BY_COUNT.get(count or 0)
    if description is not None:
        names = tuple(name for item in description.split(",") for name in _expand(item.strip(), label_set))
        for name in label_set.unknown([name for name in names if name != VOID]):
            raise ConfigError(f"{label_set.not_known(name)}; name it `other`, or add it to `sources`")
    elif own is not None and not all(NUMBERED.fullmatch(name.strip()) for name in own):
        names = tuple(own)
        check_some_known(names, label_set, where)
    elif own is None and usual is not None:
        names = tuple(_expand(usual, label_set))
    else:
        found = f"{'ids of' if count is None else count} classes"
        numbers = f" but numbers ({own[0]}, ...)" if own else ""
        advice = "cityscapes" if count is None else usual or "road,sidewalk,..."
        raise ConfigError(f"{where}: found {found} without names{numbers}; name them with ?classes={advice}")
    if len(names) != (len(names) if count is None else count):
        raise ConfigError(f"{where}: found {count} classes, and {len(names)} names {list(names)}")
    return names


def check_some_known(names: Sequence[str], label_set: LabelSet, where: str) -> None:
    """Raise ConfigError if none of a network's own names is one of a class of the map."""
    if not label_set.table_from([name for name in names if name != VOID])[:, :-1].any():
        raise ConfigError(
            f"{where}: none of its {len(names)} class names is one of the map's: {list(names)[:8]};"
            f" {label_set.not_known(names[0])}; name them with ?classes=, or in the `sources` of the class set file"
        )


def unknown_classes(names: Sequence[str], label_set: LabelSet) -> str | None:
    """What is to be said of class names that the class set does not know, all of them; None if it knows all."""
    unknown = label_set.unknown([name for name in names if name != VOID])
    if not unknown:
        return None
    return (
        f"{len(unknown)} of {len(names)} class names are unknown and count as {OTHER}: {', '.join(unknown)}"
    )


def _expand(item: str, label_set: LabelSet) -> list[str]:
    if item not in label_set.sources:
        return [item]
    source = taxonomy(item)
    ids = source.ids[source.usual_ids]
    return sorted(ids, key=lambda name: ids[name])
