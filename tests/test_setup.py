"""The set-up of the Makefile finds wheels for each platform that the README names."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def settings_of_uv() -> str:
    """The script of sed that makes them of those of pip."""
    shown = "show:\n\t@printf '%s' '$(SETTINGS)'"
    return subprocess.run(
        ["make", "--silent", "--eval", shown, "show"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("platform", "macos"),
    [("x86_64-manylinux_2_28", ""), ("aarch64-manylinux_2_28", ""), ("aarch64-apple-darwin", "14.0")],
)
def test_every_dependency_has_a_wheel_for_the_platforms_of_the_readme(platform: str, macos: str) -> None:
    uv = Path(sys.executable).with_name("uv")  # `make` has installed it
    extras = " ".join(f"--extra {name}" for name in ("segmentation", "hf", "onnx", "ros", "copc", "cluster"))
    words = (
        f"{uv} pip compile --quiet -c constraints.txt pyproject.toml {extras}"
        f" --python-platform {platform} --only-binary :all: --python-version 3.11 --no-header -o /dev/null"
    )
    script = f"eval \"$({sys.executable} -m pip config list | sed -n '{settings_of_uv()}')\"; {words}"
    environment = os.environ | {"UV_INDEX_STRATEGY": "unsafe-best-match"}
    if macos:
        environment["MACOSX_DEPLOYMENT_TARGET"] = macos
    done = subprocess.run(
        ["sh", "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
