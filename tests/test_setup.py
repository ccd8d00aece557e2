"""The set-up of the Makefile: uv finds packages where pip is told to look."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
OF_PIP = """:env:.find-links='/opt/wheels'
global.cert='/etc/ssl/some.crt'
global.extra-index-url='file:///first/simple file:///second/simple'
global.index-url='https://index.example/simple'
global.timeout='60'
"""


def test_the_settings_of_pip_are_handed_to_uv() -> None:
    shown = "show:\n\t@printf '%s' '$(SETTINGS)'"
    script = subprocess.run(
        ["make", "--silent", "--eval", shown, "show"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    told = subprocess.run(
        ["sed", "-n", script], input=OF_PIP, check=True, capture_output=True, text=True
    ).stdout
    assert told.splitlines() == [
        "export UV_FIND_LINKS='/opt/wheels'",
        "export SSL_CERT_FILE='/etc/ssl/some.crt'",
        "export UV_INDEX='file:///first/simple file:///second/simple'",
        "export UV_DEFAULT_INDEX='https://index.example/simple'",
    ]
