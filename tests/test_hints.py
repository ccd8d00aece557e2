"""Every hint to install something names an extra that a clone has; there is no index that has us."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
SOURCES = [*ROOT.glob("gnss_sem_map/**/*.py"), *ROOT.glob("factor_graphs/**/*.py")]


def test_every_hint_to_install_works_in_a_clone() -> None:
    hints = [hint for path in SOURCES for hint in re.findall(r"pip install[^\"\n]*", path.read_text())]
    assert len(hints) >= 5
    for hint in hints:
        extra = re.search(r"'\.\[([a-z]+|\{extra\})\]'", hint)
        assert extra or "onnxruntime-gpu" in hint, hint  # a package of its own, which is on the index
        assert extra is None or extra[1] == "{extra}" or extra[1] in EXTRAS, hint
    assert not any("pip install gnss-sem-map" in path.read_text() for path in SOURCES)
