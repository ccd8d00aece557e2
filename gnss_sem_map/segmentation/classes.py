"""Class names of the channels of a network: given by the user, or derived from their number."""

from __future__ import annotations

from collections.abc import Sequence

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels.label_set import LabelSet, taxonomy

VOID = "void"
"""A channel of this name has no class: it is dropped, before the softmax where we compute that."""

BY_COUNT = {6: "kitti6", 11: "camvid", 19: "cityscapes"}
"""Published street networks with that many classes have these, in the order of their ids."""


def named_classes(
    description: str | None,
    count: int | None,
    label_set: LabelSet,
    where: str,
    own: Sequence[str] | None = None,
) -> tuple[str, ...]:
    """The names of `count` channels, known to the class set, from a list of class and taxonomy names joined by commas.

    A taxonomy stands for its classes in the order of its first kind of ids. Without a description they have their
    `own` names, and without those the count decides (BY_COUNT). Without `count`, the description tells it. Raises
    ConfigError for another number of names, or a name that the class set does not know.
    """
    if description is not None:
        names = tuple(name for item in description.split(",") for name in _expand(item.strip(), label_set))
    elif own is not None:
        names = tuple(own)
    elif count in BY_COUNT:
        names = tuple(_expand(BY_COUNT[count], label_set))
    else:
        raise ConfigError(
            f"{where}: found {count} classes without names; name them with ?classes=road,sidewalk,..."
        )
    count = len(names) if count is None else count
    if len(names) != count or len(set(names)) != count:
        raise ConfigError(
            f"{where}: found {count} classes for {len(set(names))} different names {list(names)}; expected one each"
        )
    label_set.table_from([name for name in names if name != VOID])
    return names


def _expand(item: str, label_set: LabelSet) -> list[str]:
    if item not in label_set.sources:
        return [item]
    source = taxonomy(item)
    ids = source.ids[source.usual_ids]
    return sorted(ids, key=lambda name: ids[name])
