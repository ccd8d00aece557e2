"""Class sets, and the tables that map the classes of networks and data sets to them; always by name, never by index.

A `LabelSet` holds the classes of the map; a `Taxonomy` holds those of a network or data set. Both are YAML files (in
`labels/`, or the user's own).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.files.structured import read_yaml
from gnss_sem_map.files.untrusted import is_file, shown
from gnss_sem_map.labels.roles import OF_ONE_CLASS, Role

OTHER = "other"
"""Name of the class for everything that is none of the map's classes; in labels it is c, the number of these."""
OTHER_COLOUR, OTHER_SEMANTIC_KITTI_ID, OTHER_ASPRS_CODE = (140, 130, 110), 99, 66
"""Of `other` in exports, as the classes have theirs; 99 is SemanticKITTI's other-object, 66 a user code of LAS."""

SHIPPED_CLASS_SETS, ROLES = ("urban",), "roles"
"""The other files in `labels/` are taxonomies."""

UNLABELLED = -1
"""Label of a voxel or point without a class."""


@dataclass(frozen=True, eq=False)
class Legend:
    """Names, colours and codes of k answers; a label is an index into them."""

    names: tuple[str, ...]
    colours: NDArray[np.uint8]
    """(k, 3) RGB."""
    semantic_kitti_ids: NDArray[np.uint32]
    """(k,) raw ids for `.label` files."""
    asprs_codes: NDArray[np.uint8]
    """(k,) LAS classification codes."""


@dataclass(frozen=True, eq=False)
class LabelSet:
    """The classes of a map, in the order of the columns of its evidence."""

    name: str
    names: tuple[str, ...]
    """Class names, c of them."""
    colours: NDArray[np.uint8]
    """(c, 3) RGB."""
    semantic_kitti_ids: NDArray[np.uint32]
    """(c,) raw ids for `.label` files."""
    asprs_codes: NDArray[np.uint8]
    """(c,) LAS classification codes (LAS 1.4; 64 and above are user codes)."""
    sources: Mapping[str, Mapping[str, str]]
    """For every known taxonomy: its class name -> ours; absent names are `other`."""
    given_roles: tuple[Role | None, ...] | None = None
    """(c,) None: they are those of the names."""

    def __post_init__(self) -> None:
        count = len(self.names)
        if not 2 <= count <= 64 or len(set(self.names)) != count or OTHER in self.names:
            raise ConfigError(
                f"class set {self.name!r}: {list(self.names)}, expected 2 to 64 different names, no 'other'"
            )
        ids = self.semantic_kitti_ids.tolist()
        if {0, OTHER_SEMANTIC_KITTI_ID} & set(ids) or len(set(ids)) != count:
            raise ConfigError(
                f"class set {self.name!r}: found semantic_kitti_id {ids}, expected a different one each, no 0, nor"
                f" {OTHER_SEMANTIC_KITTI_ID}, which is `other`"
            )
        if len(self.roles) != count:
            raise ConfigError(f"class set {self.name!r}: found {len(self.roles)} roles for {count} classes")
        for role in OF_ONE_CLASS:
            if len(those := [self.names[i] for i in self.having(role)]) > 1:
                raise ConfigError(
                    f"class set {self.name!r}: the role {role} at {those}, expected one at most"
                )
        for source, table in self.sources.items():
            unknown = sorted(set(table.values()) - set(self.names))
            if unknown:
                raise ConfigError(
                    f"class set {self.name!r}: {source!r} maps to {unknown}, not to {list(self.names)}"
                )

    @cached_property
    def legend(self) -> Legend:
        """All that a map may say of a voxel: the classes and, last, `other`."""
        return Legend(
            (*self.names, OTHER),
            np.vstack([self.colours, np.array(OTHER_COLOUR, np.uint8)]),
            np.append(self.semantic_kitti_ids, np.uint32(OTHER_SEMANTIC_KITTI_ID)),
            np.append(self.asprs_codes, np.uint8(OTHER_ASPRS_CODE)),
        )

    @cached_property
    def roles(self) -> tuple[Role | None, ...]:
        """(c,) role of every class."""
        return roles_of_names(self.names) if self.given_roles is None else self.given_roles

    def having(self, *roles: Role) -> list[int]:
        """The classes with one of these roles, those of the first role first."""
        return [label for role in roles for label, own in enumerate(self.roles) if own == role]

    def the(self, role: Role) -> int | None:
        """The first class with this role; None where none has it."""
        return next(iter(self.having(role)), None)

    @property
    def said_of_roles(self) -> str:
        """What is said of a class set that gives no roles; empty for one that does."""
        if self.given_roles is not None:
            return ""
        count_as = (
            f"{name} as {role or 'none of them'}" for name, role in zip(self.names, self.roles, strict=True)
        )
        return (
            f"class set {self.name!r} gives no roles, and by their names its classes count so: {', '.join(count_as)};"
            f" write `role:` at its classes, one of {', '.join(Role)} or null, to say it yourself"
        )

    def index(self, name: str) -> int:
        """Index of a class; raises ConfigError with the most similar name for an unknown one."""
        if name not in self.names:
            raise ConfigError(f"class set {self.name!r}: no class {name!r}{_did_you_mean(name, self.names)}")
        return self.names.index(name)

    def about(self) -> dict[str, Any]:
        """What `open_label_set` reads back, without the sources."""
        rows = zip(
            self.names,
            self.colours.tolist(),
            self.semantic_kitti_ids.tolist(),
            self.asprs_codes.tolist(),
            strict=True,
        )
        keys = ("name", "colour", "semantic_kitti_id", "asprs_code")
        classes = [dict(zip(keys, row, strict=True)) for row in rows]
        if self.roles != roles_of_names(self.names):
            classes = [known | {"role": role} for known, role in zip(classes, self.roles, strict=True)]
        return {"name": self.name, "classes": classes}

    def table_from(self, source_names: Sequence[str]) -> NDArray[np.float32]:
        """The (s, c + 1) 0/1 matrix that sums the probabilities of s source classes into ours and, last, `other`.

        A name may be one of ours, `other`, or of any source, provided that these agree, and counts as `other` where it
        is `unknown`. Several of one name add up. Raises ConfigError for a name of which sources disagree.
        """
        table = np.zeros((len(source_names), len(self.names) + 1), np.float32)
        for row, name in enumerate(source_names):
            target = self._target(name)
            table[row, len(self.names) if target is None else target] = 1.0
        return table

    def unknown(self, source_names: Sequence[str]) -> list[str]:
        """The names that are none of ours nor of any source, each once."""
        return [name for name in dict.fromkeys(source_names) if self._target(name) is None]

    def not_known(self, name: str) -> str:
        """What is said of an unknown class, with the most similar name."""
        everything = sorted(set(self.names).union(*self._known.values()))
        return f"class {name!r} is unknown to the class set {self.name!r}{_did_you_mean(name, everything)}"

    def of_source(self, source: str, name: str) -> int:
        """Index of the class for a name of a taxonomy, c for `other`; raises ConfigError without a table of it."""
        if source not in self.sources:
            raise ConfigError(
                f"class set {self.name!r} knows no {source!r}, only {list(self.sources)}; add it to `sources`"
            )
        target = self.sources[source].get(name, OTHER)
        return len(self.names) if target == OTHER else self.names.index(target)

    @cached_property
    def _known(self) -> dict[str, set[str]]:
        """The names of every source: those in its table, and the others of its taxonomy, if that ships with us."""
        return {
            source: {*table, *(taxonomy(source).names if source in _shipped() else ())}
            for source, table in self.sources.items()
        }

    @cached_property
    def _targets(self) -> dict[str, set[int]]:
        """Where a name goes, for every name as it is written in a source and as `_plain` words."""
        found: dict[str, set[int]] = {}
        for spelling in (str, _plain):
            exact = set(found)
            for source, names in self._known.items():
                for name in names:
                    if (key := spelling(name)) not in exact:
                        found.setdefault(key, set()).add(self.of_source(source, name))
        ours = {name: {i} for i, name in enumerate((*self.names, OTHER))}
        return found | {_plain(name): target for name, target in ours.items()} | ours

    def _target(self, name: str) -> int | None:
        """The column of a class; of a name with synonyms (`road, route`), of the first that is known."""
        for word in (name, _plain(name), *map(_plain, re.split("[,;]", name))):
            if targets := self._targets.get(word):
                if len(targets) == 1:
                    return next(iter(targets))
                ours = [(*self.names, OTHER)[target] for target in sorted(targets)]
                raise ConfigError(f"class {name!r} is any of {ours} in class set {self.name!r}; name it so")
        return None


@dataclass(frozen=True, eq=False)
class Taxonomy:
    """The classes of a data set or network, with their ids."""

    name: str
    names: tuple[str, ...]
    ids: Mapping[str, Mapping[str, int]]
    """For each kind of id (such as `train_id`, or `colour`, as 0xRRGGBB): class name -> id."""
    void: Mapping[str, tuple[int, ...]]
    """For each kind of id: the ids without a class."""

    @property
    def usual_ids(self) -> str:
        """The kind of ids that is meant where none is named: the first."""
        return next(iter(self.ids))

    def lookup(self, label_set: LabelSet, kind: str, size: int = 256) -> NDArray[np.int16]:
        """Table from id to class index: c is `other`, -1 void, -2 an unknown id."""
        table = np.full(size, -2, np.int16)
        table[[i for i in self.void[kind] if 0 <= i < size]] = UNLABELLED
        for name in reversed(self.names):  # of two with one colour, the first
            row = label_set.of_source(self.name, name)
            if 0 <= self.ids[kind].get(name, -1) < size:
                table[self.ids[kind][name]] = row
        return table


def open_label_set(name_or_file: str | Path | Mapping[str, Any] = "urban") -> LabelSet:
    """Read a class set: the name of a shipped one, the user's YAML file, or what `about` gave. Raises ConfigError."""
    if isinstance(name_or_file, Mapping):
        content, said = name_or_file, brief(name_or_file)
    else:
        said = shown(name_or_file)
        content = _read(name_or_file, "class set", SHIPPED_CLASS_SETS)
    try:
        classes = content["classes"]
        return LabelSet(
            name=_word(content["name"]),
            names=tuple(_word(c["name"]) for c in classes),
            colours=np.array([[_whole(v, 256) for v in c["colour"]] for c in classes], np.uint8).reshape(
                -1, 3
            ),
            semantic_kitti_ids=np.array(
                [_whole(c["semantic_kitti_id"], 1 << 16) for c in classes], np.uint32
            ),
            asprs_codes=np.array([_whole(c["asprs_code"], 256) for c in classes], np.uint8),
            sources={
                _word(s): {_word(theirs): _word(ours) for theirs, ours in table.items()}
                for s, table in content.get("sources", {}).items()
            },
            given_roles=_given_roles(content["name"], classes),
        )
    except ConfigError:
        raise
    except _CONTENT_ERRORS as error:
        raise ConfigError(
            f"class set {said}: {type(error).__name__} {str(error)[:200]};"
            " expected name, classes (name, role, colour, semantic_kitti_id, asprs_code) and sources"
        ) from None


def _given_roles(name: str, classes: Sequence[Mapping[str, Any]]) -> tuple[Role | None, ...] | None:
    """The roles in a class set file; None where it gives none at all."""
    said = [c.get("role") for c in classes]
    if unknown := [role for role in said if role not in (None, *Role)]:
        raise ConfigError(
            f"{str(name)[:99]!r}: found the role {str(unknown[0])[:99]!r}, expected one of {[*Role]}"
        )
    given = any("role" in c for c in classes)
    return tuple(None if role is None else Role(role) for role in said) if given else None


def roles_of_names(names: Sequence[str]) -> tuple[Role | None, ...]:
    """The roles of classes of these names; of several for a role of one class, the first has it."""
    known = {name: Role(role) for role, those in _read_shipped(ROLES).items() for name in those}
    found: list[Role | None] = []
    for name in names:
        role = known.get(_plain(name))
        found.append(None if role in OF_ONE_CLASS and role in found else role)
    return tuple(found)


def taxonomy(name_or_file: str | Path) -> Taxonomy:
    """Read a taxonomy: the name of a shipped one, or the user's YAML file. Raises ConfigError.

    Classes that are names alone have ids in their order, from those that `ids` gives for the first.
    """
    content = _read(name_or_file, "taxonomy", shipped_taxonomies())
    try:
        kinds = [_word(kind) for kind in content["ids"]]
        classes = [
            c
            if isinstance(c, Mapping)
            else {"name": c} | {k: first + i for k, first in content["ids"].items()}
            for i, c in enumerate(content["classes"])
        ]
        void = content.get("void", {})
        return Taxonomy(
            name=_word(content["name"]),
            names=tuple(_word(c["name"]) for c in classes),
            ids={kind: {_word(c["name"]): _code(c[kind]) for c in classes if kind in c} for kind in kinds},
            void={kind: tuple(map(_code, void.get(kind, ()))) for kind in kinds},
        )
    except _CONTENT_ERRORS as error:
        raise ConfigError(
            f"taxonomy {shown(name_or_file)}: {type(error).__name__} {str(error)[:200]}; expected name, ids and classes"
            " with those ids"
        ) from None


_CONTENT_ERRORS = (KeyError, TypeError, ValueError, OverflowError, AttributeError, IndexError)
LONGEST_WORD = 100


def _word(value: Any) -> str:
    if (
        not isinstance(value, str | int)
        or not 0 < len(str(value)) <= LONGEST_WORD
        or not str(value).isprintable()
    ):
        raise ValueError(f"found {str(value)[:100]!r}, expected a name")
    return str(value)


def _whole(value: Any, below: int) -> int:
    if type(value) is not int or not -1 <= value < below:
        raise ValueError(f"found {str(value)[:100]!r}, expected a whole number below {below}")
    return value


def _code(value: Any) -> int:
    """An id, or a colour (red, green, blue) as one number."""
    if not isinstance(value, list):
        return _whole(value, 1 << 16)
    red, green, blue = (_whole(part, 256) for part in value)
    return red << 16 | green << 8 | blue


def _plain(name: str) -> str:
    """A name as it is compared where its spelling is not that of a source: small letters, words apart by one space."""
    return " ".join(re.split(r"[\s_-]+", name.strip().lower()))


_SHIPPED = resources.files("gnss_sem_map") / "labels"


@cache
def _shipped() -> list[str]:
    """Names of the class sets and taxonomies that ship with us."""
    files = [Path(file.name) for file in _SHIPPED.iterdir()]
    return sorted(file.stem for file in files if file.suffix == ".yaml")


def shipped_taxonomies() -> list[str]:
    """Names of the taxonomies that ship with us."""
    return [name for name in _shipped() if name not in (*SHIPPED_CLASS_SETS, ROLES)]


def _read(name_or_file: str | Path, what: str, available: Sequence[str]) -> dict[str, Any]:
    name = str(name_or_file)
    if name in available:
        return _read_shipped(name)
    if not is_file(Path(name), ConfigError):
        raise ConfigError(f"no {what} {shown(name)!r}: expected one of {list(available)} or a YAML file")
    return _read_file(Path(name))


@cache
def _read_shipped(name: str) -> dict[str, Any]:
    return _read_file(Path(str(_SHIPPED / f"{name}.yaml")))


def _read_file(file: Path) -> dict[str, Any]:
    content = read_yaml(file, ConfigError)
    if not isinstance(content, dict):
        raise ConfigError(f"{file}: found {type(content).__name__}, expected a mapping with name and classes")
    return content


def _did_you_mean(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; known are {list(known)[:12]}"
