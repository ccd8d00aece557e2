"""Every hint to install something names an extra that a clone has; there is no index that has us."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gnss_sem_map.errors import how_to_install, program

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
SOURCES = [*ROOT.glob("gnss_sem_map/**/*.py"), *ROOT.glob("factor_graphs/**/*.py")]


def test_every_hint_to_install_names_an_extra_of_the_clone() -> None:
    texts = [path.read_text() for path in SOURCES if path.name != "errors.py"]
    hints = [hint for text in texts for hint in re.findall(r"how_to_install\((.*?)\)", text)]
    assert len(hints) >= 5
    for hint in hints:
        assert hint == "extra" or hint.strip("'\"") in EXTRAS, hint
    others = [hint for text in texts for hint in re.findall(r"pip install[^\"\n]*", text)]
    assert all("onnxruntime-gpu" in hint for hint in others)  # a package of its own, which is on the index


def test_a_hint_is_a_command_of_the_environment_that_runs() -> None:
    words = shlex.split(how_to_install("hf").removeprefix("in the clone: "))
    assert words[:3] == [sys.executable, "-m", "pip"]
    assert (ROOT / words[words.index("-c") + 1]).is_file()
    assert words[-2:] == ["-e", ".[hf]"]


@pytest.mark.integration
def test_a_program_of_an_environment_that_is_not_active_is_called_by_its_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert program("gnss-sem-map") == "gnss-sem-map"
    monkeypatch.setenv("PATH", "/nowhere")
    said = subprocess.run(
        [program("gnss-sem-map"), "--version"], check=True, capture_output=True, text=True
    ).stdout
    assert said.startswith("gnss-sem-map ")
