"""The fenced blocks of the documentation, for the tests that run them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
FENCED = re.compile(r'^```(\w*)(?: title="([^"\n]*)")?\n(.*?)^```$', re.M | re.S)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    language: str
    title: str
    """What it needs that is not here, such as a drive of the reader."""
    text: str

    @property
    def lines(self) -> list[str]:
        """Its commands, one that goes on over several lines as one."""
        return self.text.replace("\\\n", " ").splitlines()


def blocks(page: Path) -> Iterator[Block]:
    for language, title, text in FENCED.findall(page.read_text("utf-8")):
        yield Block(page.name, language, title, text)


def shell(folder: Path, text: str, stands_for: Mapping[str, str] | None = None) -> str:
    """Run commands in a folder, `gnss-sem-map` as it is here, names of the reader's replaced; what they print.

    Fails where one of them does.
    """
    for name, stand_in in (stands_for or {}).items():
        text = re.sub(rf"(?<![\w/]){re.escape(name)}(?!\w)", stand_in, text)
    ours = folder / ".bin" / "gnss-sem-map"
    ours.parent.mkdir(exist_ok=True)
    ours.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m gnss_sem_map.cli "$@"\n', "utf-8")
    ours.chmod(0o755)
    return _done(
        ["bash", "-e", "-c", text.replace(".venv/bin/gnss-sem-map", "gnss-sem-map")],
        folder,
        PATH=f"{ours.parent}:{os.environ['PATH']}",
        BROWSER="true",  # a browser that shows nothing
    )


def python(folder: Path, *words: str, answer: str = "") -> str:
    """Run Python in a folder; what it prints. Fails where it does."""
    return _done([sys.executable, *words], folder, answer)


def _done(command: list[str], folder: Path, answer: str = "", **variables: str) -> str:
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | variables,
        input=answer,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{command[-1]}\n{done.stdout}{done.stderr}"
    return done.stdout
