"""What a benchmark measures is kept with the machine and the commit that it was measured with."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
OLD = {"machine": "a processor", "first": {"ratio": 2.0}, "second": {"ratio": 3.0}}


def module(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


results_file = module("benchmarks/results_file.py")


def test_every_part_says_what_it_was_made_by(tmp_path: Path) -> None:
    file = tmp_path / "results" / "some.json"
    results_file.keep(file, {"first": {"ratio": 2.0}}, "numpy")
    results_file.keep(file, {"second": {"ratio": 3.0}})
    results_file.keep(file, {"first": {"ratio": 4.0}})
    kept = json.loads(file.read_text("utf-8"))
    made_by = kept.pop("made by")
    assert kept == {"first": {"ratio": 4.0}, "second": {"ratio": 3.0}}
    assert set(made_by) == set(kept)
    for text in made_by.values():
        assert re.fullmatch(r"\w+, \d+ cores, Python [\d.]+\w*, commit .+", text)


def test_the_commit_is_the_one_that_is_checked_out_if_any_is() -> None:
    asked = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout or "not known"
    named = results_file.made_by().rpartition("commit ")[2].removesuffix(" with changes")
    assert named
    assert commit.startswith(named)


def test_old_results_keep_their_machine_until_the_last_of_them_is_measured_again(tmp_path: Path) -> None:
    file = tmp_path / "some.json"
    file.write_text(json.dumps(OLD), "utf-8")
    results_file.keep(file, {"first": {"ratio": 4.0}})
    assert json.loads(file.read_text("utf-8"))["machine"] == "a processor"
    results_file.keep(file, {"second": {"ratio": 5.0}})
    assert "machine" not in json.loads(file.read_text("utf-8"))


def test_the_page_says_what_is_not_recorded(tmp_path: Path) -> None:
    said = module("docs/site/generated_pages.py")._made_by
    assert said(dict(OLD)) == "Measured on: a processor, commit not recorded."
    assert said({"first": 1}) == "Measured on: machine not recorded, commit not recorded."
    file = tmp_path / "some.json"
    file.write_text(json.dumps(OLD), "utf-8")
    results_file.keep(file, {"first": {"ratio": 4.0}})
    page = said(json.loads(file.read_text("utf-8")))
    assert "- second: a processor, commit not recorded" in page
    assert f"- first: {results_file.made_by()}" in page


def test_all_benchmarks_keep_their_results_so() -> None:
    for file in (ROOT / "benchmarks" / "results").glob("*.json"):
        code = (ROOT / "benchmarks" / f"{file.stem}.py").read_text("utf-8")
        assert re.search(r"from results_file import .*\bkeep\b", code), file.stem
        assert isinstance(json.loads(file.read_text("utf-8")), dict), file.stem
