"""The examples of `factor_graphs` run as they stand, and what they print is as good as they say."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs an example and returns the lines that it prints."""

    def run(name: str, *arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run


def test_fix_by_fix_it_is_better_than_the_fixes_and_says_how_good(printed) -> None:
    _, *lines, last = printed("streaming.py", "--seconds", "90")
    _, error, stddev = np.array([line.split() for line in lines], dtype=np.float64).T
    rms, alone = (float(value) for value in re.findall(r"([\d.]+) m", last))
    assert len(lines) == 6
    assert rms < alone
    assert 0.3 < np.sqrt(np.mean(error**2) / np.mean(stddev**2)) < 2


@pytest.mark.slow
def test_smoothing_beats_filtering_and_the_graph_beats_both(printed) -> None:
    table = [re.split(r"\s{2,}", line) for line in printed("kalman_baseline.py", "--drives", "1")[1:]]
    figures = {name: [float(value.removesuffix(" %")) for value in row] for name, *row in table}
    assert list(figures) == ["EKF", "EKF + RTS", "factor graph"]
    horizontal, lost, heading, inside = np.array(list(figures.values())).T
    for falling in (horizontal, lost, heading):
        assert (np.diff(falling) < 0).all()
    assert (inside > 60).all()


@pytest.mark.parametrize(
    "line",
    [
        "streaming.py --seconds 31",
        "kalman_baseline.py --seconds 60",
        "kalman_baseline.py --drives 0",
        "training_images.py streets 3 2",
        "training_images.py streets 1 1 --every 0",
    ],
)
def test_an_example_refuses_what_would_give_no_figures(
    printed, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        printed(*line.split())
    assert list(tmp_path.iterdir()) == []
