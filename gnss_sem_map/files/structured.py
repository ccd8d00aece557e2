"""Safe loaders for YAML and JSON: with limits on size, depth and time, and without code execution.

In our YAML only true and false are truth values (`vehicles: off` is a word, as it looks), dates and times are words,
there are no tags, and no key is there twice. Aliases count as much as what they stand for, so that a few lines cannot
stand for a billion.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from gnss_sem_map.errors import DataError, SemMapError, one_line
from gnss_sem_map.files.untrusted import read_text, shown

if TYPE_CHECKING:
    from pydantic import ValidationError

MOST_YAML_BYTES, LONGEST_YAML_LINE = 2 << 20, 20_000
MOST_JSON_BYTES = 64 << 20
MOST_NODES = 200_000
DEEPEST = 30
MOST_DIGITS = 40


class _Refused(yaml.YAMLError):
    """YAML that is valid but not accepted."""


class _Loader(yaml.SafeLoader):
    """Loader of scalars, lists and mappings, with a limit on their number."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = 0
        self._weights: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one node with its children, and count them; an alias counts as its target."""
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise _Refused(f"found the tag {event.tag!r}, expected none")
        is_alias = isinstance(event, yaml.AliasEvent)
        before = self._count
        self._count += 1
        self._depth += 1
        if self._depth > DEEPEST:
            raise _Refused(f"nested deeper than {DEEPEST} levels")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias:
            if id(node) not in self._weights:
                raise _Refused("an alias stands for something that it is part of")
            self._count += self._weights[id(node)]
        else:
            self._weights[id(node)] = self._count - before
            _refuse_repeated_keys(node)
        if self._count > MOST_NODES:
            raise _Refused(f"more than {MOST_NODES} values, aliases written out")
        return node

    def resolve(self, kind: type[yaml.Node], value: str | None, implicit: Any) -> str:
        """The tag of a node; what has a colon in it is text: YAML 1.1 takes 12:30:45 for 45045."""
        if kind is yaml.ScalarNode and ":" in (value or ""):
            return str(self.DEFAULT_SCALAR_TAG)
        return str(super().resolve(kind, value, implicit))

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """A whole number with a limited number of digits."""
        if len(node.value) > MOST_DIGITS:
            raise _Refused(f"a number of {len(node.value)} digits, expected at most {MOST_DIGITS}")
        return int(super().construct_yaml_int(node))


def _refuse_repeated_keys(node: yaml.Node | None) -> None:
    """Raise an error for a mapping with a key twice, of which the first value would be lost."""
    found = set()
    for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
        if isinstance(key, yaml.ScalarNode):
            if (key.tag, key.value) in found:
                raise _Refused(
                    f"found the key {key.value[:50]!r} twice, again in line {key.start_mark.line + 1}; remove one"
                )
            found.add((key.tag, key.value))


_REPLACED = ("tag:yaml.org,2002:bool", "tag:yaml.org,2002:timestamp")
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _REPLACED]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile("^(true|false)$"), list("tf"))
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def parse_yaml(text: str) -> Any:
    """Parse YAML text; raises ValueError with one line for text that is not valid or not accepted."""
    if max(map(len, text.split("\n"))) > LONGEST_YAML_LINE:
        raise ValueError(f"a line of more than {LONGEST_YAML_LINE} characters")
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(one_line(error)) from None


def read_yaml(path: Path, error: type[SemMapError] = DataError) -> Any:
    """Read a YAML file; raises `error` for a file that cannot be read or is not accepted."""
    try:
        return parse_yaml(read_text(path, MOST_YAML_BYTES, error))
    except SemMapError:
        raise
    except ValueError as problem:
        raise error(f"{shown(path)}: not YAML ({problem})") from None


def read_json(path: Path, error: type[SemMapError] = DataError) -> dict[str, Any]:
    """The mapping that a JSON file holds; raises `error` for anything else."""
    text = read_text(path, MOST_JSON_BYTES, error)
    try:
        content = json.loads(text)
    except RecursionError:
        raise error(f"{shown(path)}: damaged (nested too deep)") from None
    except ValueError as problem:
        raise error(f"{shown(path)}: damaged ({one_line(problem)})") from None
    if not isinstance(content, dict):
        raise error(f"{shown(path)}: damaged (found {type(content).__name__}, expected a mapping)")
    return content


def fault_of(error: ValidationError) -> str:
    """The first fault that pydantic found in the content of a file: its place, and what is wrong, in one line."""
    first = error.errors()[0]
    place = " ".join(".".join(map(str, first["loc"])).split())
    return f"{place[:100]}: {first['msg'][:200]}"


def not_finite(content: Any, place: str = "") -> str | None:
    """Path, such as `a.b.0`, of the first number in nested lists and mappings that is infinite or NaN; else None."""
    if isinstance(content, float) and not math.isfinite(content):
        return place
    parts = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    for name, part in parts:
        found = not_finite(part, f"{place}.{name}" if place else str(name))
        if found is not None:
            return found
    return None
