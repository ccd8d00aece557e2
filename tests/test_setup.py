"""The set-up of the Makefile: uv finds packages where pip is told to look, and wheels for each platform we name."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OF_PIP = """:env:.find-links='/opt/wheels'
global.cert='/etc/ssl/some.crt'
global.extra-index-url='file:///first/simple file:///second/simple'
global.index-url='https://index.example/simple'
global.timeout='60'
"""


def settings_of_uv() -> str:
    """The script of sed that makes them of those of pip."""
    shown = "show:\n\t@printf '%s' '$(SETTINGS)'"
    return subprocess.run(
        ["make", "--silent", "--eval", shown, "show"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def test_the_settings_of_pip_are_handed_to_uv() -> None:
    script = settings_of_uv()
    told = subprocess.run(
        ["sed", "-n", script], input=OF_PIP, check=True, capture_output=True, text=True
    ).stdout
    assert told.splitlines() == [
        "export UV_FIND_LINKS='/opt/wheels'",
        "export SSL_CERT_FILE='/etc/ssl/some.crt'",
        "export UV_INDEX='file:///first/simple file:///second/simple'",
        "export UV_DEFAULT_INDEX='https://index.example/simple'",
    ]


@pytest.mark.parametrize(
    ("backend", "asked"), [({}, ["uv", "pip"]), ({"UV_TORCH_BACKEND": "cpu"}, ["uv"])], ids=["none", "cpu"]
)
def test_pip_takes_the_place_of_uv_unless_a_build_of_torch_is_asked_for(
    backend: dict[str, str], asked: list[str], tmp_path: Path
) -> None:
    """pip does not know of it, and would take another build."""
    for name, code in (("uv", 1), ("pip", 0)):
        program = tmp_path / name
        program.write_text(
            f'#!/bin/sh\nfor word; do test "$word" = install && echo {name}; done\nexit {code}\n'
        )
        program.chmod(0o755)
    words = ["make", "--silent", f"BIN={tmp_path}", "--eval", "try:\n\t$(call install,.)", "try"]
    environment = {name: value for name, value in os.environ.items() if name != "UV_TORCH_BACKEND"} | backend
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == asked
    assert (done.returncode == 0) == (not backend)


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
