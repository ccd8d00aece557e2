"""Pages of the site that are made from the program itself: home, settings, commands, Python API, benchmarks, notebooks.

MkDocs calls `on_files`, and `on_page_markdown` for every page (mkdocs.yml, `hooks`). Nothing that is made here is
committed.
"""

from __future__ import annotations

import ast
import base64
import json
import posixpath
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"
COPIED = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "gnss_sem_map/segmentation/demo_network/README.md": "demo_network.md",
}
"""Texts outside docs/ that are pages of the site."""
PROGRAM = "gnss-sem-map"
TYPE_NAMES = {str: "text", int: "whole number", float: "number", bool: "true or false", Path: "file"}
MOST_ROWS = 16
"""Parts of a result with more figures are divided further."""
EXECUTED = ROOT / "build" / "notebooks"
"""Where `make notebooks` leaves the notebooks with their output."""


def on_files(files: Any, config: Any) -> Any:
    """Add the pages to those of `docs/`."""
    from mkdocs.structure.files import File

    for path, content in pages():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Formulas as MathML, drawn without a script; links to sources, which are not in the site, as text."""
    markdown = re.sub(r"```math\n(.*?)```", lambda found: _formula(found[1], "block"), markdown, flags=re.S)
    markdown = re.sub(r"\$`(.*?)`\$", lambda found: _formula(found[1], "inline"), markdown)
    return re.sub(r"\[([^\]]*)\]\((\.\./[^)]*)\)", lambda found: _link(found, "docs"), markdown)


def _formula(latex: str, display: str) -> str:
    from latex2mathml.converter import convert

    formula = convert(" ".join(latex.split()), display=display)
    return f"<div>{formula}</div>" if display == "block" else f"<span>{formula}</span>"


def pages() -> Iterator[tuple[str, str | bytes]]:
    """Path in the site and content of every page and picture."""
    for source, path in COPIED.items():
        yield path, of_the_repository(source)
    yield "settings.md", settings_page()
    yield "commands.md", commands_page()
    yield "api.md", api_page()
    yield "benchmarks.md", benchmarks_page()
    for notebook in sorted((ROOT / "examples").glob("*.ipynb")):
        yield from notebook_page(notebook)


# --- text of the repository ---------------------------------------------------------------------------------------


def of_the_repository(name: str) -> str:
    """A page outside docs/, with the links to docs/ as they are in the site."""
    text = (ROOT / name).read_text("utf-8").replace('src="docs/', 'src="')
    return re.sub(r"\[([^\]]*)\]\(([^)]*)\)", lambda found: _link(found, posixpath.dirname(name)), text)


def _link(found: re.Match[str], folder: str) -> str:
    """A link in a file of `folder` as one of the site; what is not in the site stays as text."""
    target, hash_, heading = found[2].partition("#")
    if not target or "://" in target:
        return found[0]
    path = posixpath.normpath(posixpath.join(folder, target))
    if path in COPIED:
        return f"[{found[1]}]({COPIED[path]}{hash_}{heading})"
    return (
        f"[{found[1]}]({path.removeprefix('docs/')}{hash_}{heading})"
        if path.startswith("docs/")
        else found[1]
    )


# --- settings -----------------------------------------------------------------------------------------------------


def settings_page() -> str:
    """Every setting with default and description, a table per section."""
    from gnss_sem_map.config import Settings

    head = (
        "# Settings\n\nAll settings of a run, with their defaults. `gnss-sem-map config` prints them as YAML, "
        "`--config FILE` reads such a file, and `--set section.name=value` changes one. An unknown name is an "
        "error. This page is made from the models that check them.\n"
    )
    return head + "".join(_sections(Settings(), ""))


def _sections(section: Any, place: str) -> Iterator[str]:
    """The table of a section, then those of the sections in it."""
    from pydantic import BaseModel

    plain = section.model_dump(mode="json")
    rows, inner = [], []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            inner.append((name, value, field.description or ""))
        else:
            rows.append(
                (f"`{name}`", _type_name(field.annotation), _default(plain[name]), field.description or "")
            )
    if rows:
        yield _table(("setting", "type", "default", "meaning"), rows)
    for name, value, description in inner:
        path = f"{place}.{name}".lstrip(".")
        yield f"\n{'#' * min(2 + path.count('.'), 4)} {path}\n\n{description}\n"
        yield from _sections(value, path)


def _type_name(annotation: Any) -> str:
    """A type as one would say it: choices by their values, without None and validators."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(_default(value) for value in inner)
    if origin is Annotated:
        return _type_name(inner[0])
    if origin in (Union, UnionType):
        return " or ".join(_type_name(part) for part in inner if part is not NoneType)
    if origin is not None:
        return f"{origin.__name__} of {', '.join(map(_type_name, inner))}"
    return TYPE_NAMES.get(annotation, annotation.__name__)


def _default(value: Any) -> str:
    return f"`{json.dumps(value, ensure_ascii=False)}`"


# --- commands -----------------------------------------------------------------------------------------------------


def commands_page() -> str:
    """Usage, text, arguments and options of every command, from their parsers."""
    import typer

    from gnss_sem_map.cli import app

    group: Any = typer.main.get_command(app)
    parts = [
        "# Commands\n\nMade from the parsers of the program; `gnss-sem-map COMMAND --help` prints the same. "
        "Exit codes: 0 done, 1 an error (one line on stderr), 2 wrong usage, 128 plus its number for a signal.\n"
    ]
    for name, command in group.commands.items():
        context = typer.Context(command, info_name=f"{PROGRAM} {name}")
        records = (parameter.get_help_record(context) for parameter in command.params)
        rows = [(f"`{_names(names)}`", _escaped(text)) for names, text in filter(None, records)]
        needed = [
            _names(parameter.get_help_record(context)[0])
            for parameter in command.params
            if parameter.required
        ]
        text = "\n".join(line.strip() for line in (command.help or "").splitlines())
        parts.append(
            f"\n## {name}\n\n{text}\n\n```text\n{' '.join([PROGRAM, name, *needed, '[OPTIONS]'])}\n```\n"
        )
        parts.append(_table(("argument or option", "meaning"), rows))
    return "".join(parts)


def _names(record: str) -> str:
    """`out <path>` is OUT, `-o, --out <path>` stays."""
    record = re.sub(r"<list\[(\w+)\]>", r"<\1>", record)
    return record if record.startswith("-") else record.split(" <")[0].upper()


# --- Python API ---------------------------------------------------------------------------------------------------


def api_page() -> str:
    """The public names of both packages; mkdocstrings writes what they say."""
    parts = [
        "# Python API\n\nThe public names: what `from gnss_sem_map import ...` and `from factor_graphs import ...` "
        "give. Everything else may change. Inside, units are SI; other units are in the names.\n"
    ]
    for package in ("gnss_sem_map", "factor_graphs"):
        tree = ast.parse((ROOT / package / "__init__.py").read_text("utf-8"))
        places = {
            alias.name: f"{node.module}.{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(package)
            for alias in node.names
        }
        parts.append(f"\n## {package}\n\n")
        parts += [f"::: {places[name]}\n\n" for name in sorted(places, key=str.lower)]
    return "".join(parts)


# --- benchmarks ---------------------------------------------------------------------------------------------------


def benchmarks_page() -> str:
    """All figures of benchmarks/results/, with command, machine and commit, as far as they are recorded."""
    parts = [
        "# Benchmarks\n\nAll figures that the benchmarks wrote, as they are in `benchmarks/results/`, with the machine "
        "and the commit that they were measured with, and the last commit that changed the file. "
        "What they mean: [results](results.md), [scale](scale.md), [sessions](sessions.md). "
        "Names carry the units; a share is between 0 and 1. Compare ratios between machines, not times.\n"
    ]
    for file in sorted((BENCHMARKS / "results").glob("*.json")):
        figures = json.loads(file.read_text("utf-8"))
        about = ast.get_docstring(ast.parse((BENCHMARKS / f"{file.stem}.py").read_text("utf-8"))) or ""
        command = re.search(r"python benchmarks/.*(?:\n +[\[-].*)*", about)
        made_by = _made_by(figures)
        parts.append(f"\n## {file.stem}\n\n{about.splitlines()[0]}\n\n")
        parts.append(f"```text\n{command[0] if command else ''}\n```\n\n")
        parts.append(f"{made_by}\n\nLast change of the file: {_commit(file)}.\n")
        parts += _figures(figures, "")
    return "".join(parts)


def _made_by(figures: dict[str, Any]) -> str:
    """Machine and commit of every part of some results, which are taken out of them; old results name but a machine."""
    made, machine = figures.pop("made by", {}), figures.pop("machine", None)
    old = f"{_in_words(machine) or 'machine not recorded'}, commit not recorded"
    parts: dict[str, list[str]] = {}
    for name in figures:
        parts.setdefault(made.get(name, old), []).append(_escaped(name))
    if len(parts) == 1:
        return f"Measured on: {next(iter(parts))}."
    return "Measured on:\n\n" + "\n".join(f"- {', '.join(names)}: {by}" for by, names in parts.items())


def _commit(file: Path) -> str:
    """The last commit that changed a file, with its date."""
    asked = ["git", "-C", str(ROOT), "log", "-1", "--format=`%h` of %cs", "--", str(file)]
    try:
        return (
            subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
            or "not committed"
        )
    except (OSError, subprocess.CalledProcessError):
        return "not known outside a clone"


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_in_words(inner)}" for key, inner in value.items())
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, list):
        return ", ".join(map(_in_words, value))
    return "" if value is None else str(value)


def _figures(figures: Any, title: str) -> Iterator[str]:
    """Nested results as tables: parts with figures of the same names stand beside each other in one table."""
    if isinstance(figures, list):
        figures = {str(number): part for number, part in enumerate(figures, 1)}
    tables: dict[tuple[str, ...], dict[str, list[str]]] = {}
    deeper, alone = [], {}
    for name, part in figures.items():
        flat = dict(_flat(part))
        if not _nested(part):
            alone[name] = _in_words(part)
        elif len(flat) <= MOST_ROWS:
            tables.setdefault(tuple(flat), {})[name] = [_in_words(value) for value in flat.values()]
        else:
            deeper.append((name, part))
    if title and (alone or tables):
        yield f"\n**{title}**\n"
    if alone:
        yield _table(("figure", "value"), [(_escaped(name), value) for name, value in alone.items()])
    for names, columns in tables.items():
        rows = zip(map(_escaped, names), *columns.values(), strict=True)
        yield _table(("figure", *map(_escaped, columns)), list(rows))
    for name, part in deeper:
        yield from _figures(part, f"{title}: {name}" if title else name)


def _flat(part: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The figures in a part and in the parts of it, each with the names on the way to it."""
    if not _nested(part):
        yield name, part
        return
    inner = (
        part.items() if isinstance(part, Mapping) else ((str(k), value) for k, value in enumerate(part, 1))
    )
    for key, value in inner:
        yield from _flat(value, f"{name}, {key}".lstrip(", "))


def _nested(value: Any) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, list) and any(map(_nested, value)))


# --- notebooks ----------------------------------------------------------------------------------------------------


def notebook_page(notebook: Path) -> Iterator[tuple[str, str | bytes]]:
    """A notebook as a page with its pictures: with output if `make notebooks` executed it, otherwise without."""
    executed = EXECUTED / notebook.name
    cells = json.loads((executed if executed.is_file() else notebook).read_text("utf-8"))["cells"]
    place = f"notebooks/{notebook.stem}"
    parts = []
    for number, cell in enumerate(cells):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for index, output in enumerate(cell.get("outputs", ())):
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{place}_{number}_{index}.png"
                yield picture, base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Output of the cell above]({Path(picture).name})")
            else:
                printed = "".join(output.get("text", data.get("text/plain", "")))
                parts.append(f"```text\n{printed.rstrip()}\n```")
    note = "" if executed.is_file() else "\n\n*Without output: `make notebooks` executes it.*"
    first, *others = parts
    title, _, rest = first.partition("\n")
    yield (
        f"{place}.md",
        f"{title}\n\n`examples/{notebook.name}`{note}\n{rest}\n\n" + "\n\n".join(others) + "\n",
    )


# --- tables -------------------------------------------------------------------------------------------------------


def _escaped(text: str) -> str:
    return re.sub(r"([|<>{}\[\]*_])", r"\\\1", " ".join(text.split()))


def _table(heads: tuple[str, ...], rows: list[Any]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)
