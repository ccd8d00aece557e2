"""The documentation: its commands are taken by their parsers, its snippets run, its links lead somewhere.

A block with a title is not run here: the title says what it needs, such as a cluster or a drive of the reader. Its
commands are parsed and its Python is compiled all the same. `test_pages.py` runs whole pages, with drives that stand
for those of the reader.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from pages import FENCED, ROOT, TEXTS, Block, blocks, python

from gnss_sem_map import config
from gnss_sem_map.cli import app
from gnss_sem_map.datasets.log_yaml import LogFile

COMMANDS: Any = typer.main.get_command(app)
OTHERS = {"cd", "dask", "export", "git", "make", "source", "python3", ".venv/bin/pip"}
"""Programs that are not ours."""


BLOCKS = [block for page in TEXTS for block in blocks(page)]
LINES = [
    pytest.param(line, id=f"{block.page}: {line[:60]}")
    for block in BLOCKS
    if block.language == "bash"
    for line in block.lines
]
IN_TEXT = sorted(
    {
        " ".join(code.split())
        for page in TEXTS
        for code in re.findall(
            r"`((?:gnss-sem-map|make|python|pytest) [^`]+)`", FENCED.sub("", page.read_text("utf-8"))
        )
    }
)


@pytest.mark.parametrize("line", LINES)
def test_a_command_is_taken_by_its_parser(line: str) -> None:
    words = shlex.split(line, comments=True)
    if words[0] in ("gnss-sem-map", ".venv/bin/gnss-sem-map"):
        command = COMMANDS.commands[words[1]]
        taken = command.make_context(words[1], words[2:]).params
        config.load(overrides=taken.get("set_") or ())
        named = taken.get("config")
        assert named is None or (ROOT / named).is_file()
    elif words[0] == "dask":
        dask_parser(words[1]).make_context(words[1], words[2:])
    else:
        assert words[0] in OTHERS


def dask_parser(name: str) -> Any:
    from distributed.cli import dask_scheduler, dask_worker

    return {"scheduler": dask_scheduler, "worker": dask_worker}[name].main


@pytest.mark.parametrize("code", IN_TEXT)
def test_what_text_calls_a_command_is_one(code: str) -> None:
    program, name, *words = code.split()
    options = {word.split("=")[0] for word in words if word.startswith("-")}
    if program == "gnss-sem-map":
        if name == "COMMAND":
            return
        is_of_all = name.startswith("-")
        parameters = COMMANDS.params if is_of_all else COMMANDS.commands[name].params
        known = {option for each in parameters for option in (*each.opts, *each.secondary_opts)}
        assert options | ({name} if is_of_all else set()) <= known | {"--help", "-h"}
    elif program == "make":
        makefile = (ROOT / "Makefile").read_text("utf-8")
        targets, variables = (set(re.findall(rf"^([\w-]+){sign}", makefile, re.M)) for sign in (":", r" \?="))
        assigned = {word for word in words if "=" in word}
        assert {name, *words} - assigned <= targets
        assert {word.split("=")[0] for word in assigned} <= variables
    else:
        path = ROOT / name.split("::")[0]
        assert path.exists()
        assert path.is_dir() or all(f'"{option}"' in path.read_text("utf-8") for option in options)


def test_every_night_makes_targets_that_there_are() -> None:
    night = yaml.safe_load((ROOT / ".github/workflows/nightly.yml").read_text("utf-8"))
    made = night["jobs"]["tests"]["strategy"]["matrix"]["target"]
    assert set(made) <= set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.language == "python"], ids=lambda b: b.page
)
def test_a_snippet_runs(block: Block, tmp_path: Path) -> None:
    compile(block.text, block.page, "exec")
    if block.title or block.page in ("tutorial.md", "README.md"):  # see test_pages.py and test_readme.py
        return
    (tmp_path / "snippet.py").write_text(block.text, "utf-8")
    python(tmp_path, "snippet.py", answer="\n")


@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.language == "yaml"], ids=lambda b: b.page
)
def test_a_file_of_settings_is_yaml(block: Block) -> None:
    assert isinstance(yaml.safe_load(block.text), dict)


def test_every_key_of_a_csv_log_has_its_meaning() -> None:
    pages = "".join((ROOT / "docs" / name).read_text("utf-8") for name in ("your_own_log.md", "trust.md"))
    rows = "".join(line.split("|")[1] for line in pages.splitlines() if line.startswith("| `"))
    assert [key for key in LogFile.model_fields if f"`{key}`" not in rows] == []


# --- links ------------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as a forge and MkDocs make them."""
    found = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in found}


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_a_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8"))
    for link in links:
        if link.startswith(("https://", "mailto:")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


# --- pages that are made -----------------------------------------------------------------------------------------


def generated() -> Any:
    spec = importlib.util.spec_from_file_location("generated_pages", ROOT / "docs/site/generated_pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def names_of(settings: dict[str, Any]) -> Iterator[str]:
    for name, value in settings.items():
        yield name
        if isinstance(value, dict):
            yield from names_of(value)


def test_every_setting_has_a_row_with_its_meaning() -> None:
    page = generated().settings_page()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    heads = [line for line in page.splitlines() if line.startswith("##")]
    named = list(names_of(config.load().model_dump()))
    assert len(rows) + len(heads) == len(named) > 100
    assert all(f"| `{name}` |" in page or re.search(rf"^#+ .*\b{name}$", page, re.M) for name in named)
    assert not [row for row in rows if row.rstrip("| ").endswith("`")], "a setting without a meaning"
