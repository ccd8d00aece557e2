"""The README's Python snippets run as they stand, and its paths exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import street
from street import Street

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.S)


def test_there_are_four_snippets_of_at_most_six_lines() -> None:
    assert len(SNIPPETS) == 4
    assert all(len([line for line in snippet.splitlines() if line.strip()]) <= 6 for snippet in SNIPPETS)


def test_the_snippets_run(
    small_drive: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "PROBABILITIES").symlink_to(small_drive.labels)
    log = street.write_table_log(tmp_path / "table", small_drive)
    for name in ("log", "drive"):
        (tmp_path / name).symlink_to(log)
    for snippet in SNIPPETS:
        exec(compile(snippet, "README.md", "exec"), {})
    assert (tmp_path / "other" / "map.laz").is_file()
    assert len(capsys.readouterr().out.splitlines()) > 3


def test_every_path_that_is_named_exists() -> None:
    named = re.findall(
        r"(?:\(|`|\s)((?:docs|examples|benchmarks|gnss_sem_map|factor_graphs|tests)/[\w./-]*\w)", README
    )
    assert len(named) > 5
    assert [path for path in named if not (ROOT / path).exists()] == []
