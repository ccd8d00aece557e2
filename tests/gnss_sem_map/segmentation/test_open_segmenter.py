"""The one door to all segmenters: cheap to open, and clear about what is missing."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from gnss_sem_map.errors import ConfigError, how_to_install, program
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import SCHEMES, no_segmenter_message, open_segmenter
from gnss_sem_map.segmentation.classes import named_classes, unknown_classes

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


@pytest.mark.parametrize(
    ("count", "own", "said"),
    [
        (19, [f"LABEL_{i}" for i in range(19)], "numbers (LABEL_0, ...); name them with ?classes=cityscapes"),
        (150, [str(i) for i in range(150)], "numbers (0, ...); name them with ?classes=ade20k"),
        (65, [f"class {i}" for i in range(65)], "name them with ?classes=mapillary"),
        (7, [f"LABEL_{i}" for i in range(7)], "name them with ?classes=road,sidewalk,..."),
        (7, None, "found 7 classes without names; name them with ?classes=road,sidewalk,..."),
        (3, ["cat", "dog", "hen"], "none of its 3 class names is one of the map's: ['cat', 'dog', 'hen']"),
    ],
)
def test_networks_without_names_are_told_how_to_name_them(
    count: int, own: list[str] | None, said: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        named_classes(None, count, URBAN, "net", own)
    assert said in str(caught.value)


def test_networks_of_known_data_sets_need_no_names() -> None:
    for count, first, last in ((19, "road", "bicycle"), (65, "Bird", "Ego Vehicle"), (150, "wall", "flag")):
        names = named_classes(None, count, URBAN, "net")
        assert (len(names), names[0], names[-1]) == (count, first, last)


def test_several_classes_of_one_name_add_up() -> None:
    names = named_classes("road,road,car,bus,sky,void", 6, URBAN, "net")
    assert names == ("road", "road", "car", "bus", "sky", "void")
    own = named_classes(None, 3, URBAN, "net", ["road", "road", "blimp"])
    seen = np.array([0.3, 0.4, 0.3], np.float32) @ URBAN.table_from(own)
    np.testing.assert_allclose(seen, [0.7, 0, 0, 0, 0, 0.3])
    assert unknown_classes(own, URBAN) == "1 of 3 class names are unknown and count as other: blimp"
