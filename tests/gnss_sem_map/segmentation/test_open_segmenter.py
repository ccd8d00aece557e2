"""The one door to all segmenters: cheap to open, and clear about what is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gnss_sem_map.errors import ConfigError, how_to_install, program
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import SCHEMES, no_segmenter_message, open_segmenter

URBAN = open_label_set("urban")

WITHOUT = """
import sys
for name in {absent!r}:
    sys.modules[name] = None
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
assert not set(sys.modules) & {{"torch", "cv2", "transformers", "onnxruntime"}} - set({absent!r})
try:
    open_segmenter({spec!r}, open_label_set("urban"))
except ConfigError as error:
    print(error)
"""


@pytest.mark.integration
@pytest.mark.parametrize(
    ("spec", "absent", "extra"),
    [
        ("refinenet:net.pth", ["torch"], "segmentation"),
        ("demo", ["torch"], "segmentation"),
        ("hf:some/model", ["transformers"], "hf"),
        ("onnx:net.onnx", ["onnxruntime"], "onnx"),
    ],
)
def test_nothing_heavy_is_imported_before_it_is_needed_and_a_missing_extra_is_named(
    spec: str, absent: list[str], extra: str
) -> None:
    code = WITHOUT.format(spec=spec, absent=absent)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"{absent[0]} is not installed; {how_to_install(extra)}" in done.stdout


def test_an_unknown_kind_is_answered_with_all_there_are() -> None:
    with pytest.raises(ConfigError, match="unknown kind 'openvino'") as caught:
        open_segmenter("openvino:net.xml", URBAN)
    assert all(f"'{how}'" in str(caught.value) or f'"{how}"' in str(caught.value) for how in SCHEMES.values())


def test_a_drive_without_labels_is_answered_with_three_networks_their_commands_and_licences() -> None:
    message = no_segmenter_message("my_drive")
    offers = [line for line in message.splitlines() if "--segmenter hf:" in line]
    assert len(offers) == 3
    for offer in offers:
        model = offer.split("hf:")[1].split()[0]
        assert offer.strip().startswith(
            f"{program('hf')} download {model} && {program('gnss-sem-map')} run my_drive "
        )
        assert any(word in offer for word in ("licence", "not for commerce"))
