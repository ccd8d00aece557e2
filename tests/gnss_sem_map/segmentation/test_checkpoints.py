"""A checkpoint gives back the network that was saved, and nothing but tensors is ever read from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.checkpoints import write_network
from gnss_sem_map.segmentation.networks import NetworkSegmenter
from gnss_sem_map.segmentation.refinenet import MEAN, STD, LightWeightRefineNet
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
PIXELS = np.random.default_rng(0).integers(0, 256, (45, 83, 3), dtype=np.uint8)
KITTI6 = ("sky", "building", "road", "sidewalk", "vegetation", "car")


def camera(pixels: np.ndarray = PIXELS, number: int = 0) -> Image:
    return Image(number, 0.0, lambda: pixels)


def network(classes: int = 6, **layout: Any) -> Any:
    torch.manual_seed(0)
    return LightWeightRefineNet(classes, "mobilenet_v2", **({"width": 24} | layout)).eval()


def expected_probabilities(net: Any, shrink: int) -> np.ndarray:
    """By hand: cut to sides that divide, normalise, run, enlarge, softmax."""
    height, width = 45 // shrink, 83 // shrink
    x = torch.tensor(PIXELS[: height * shrink, : width * shrink] / 255.0, dtype=torch.float32)
    x = (x - torch.tensor(MEAN)) / torch.tensor(STD)
    with torch.inference_mode():
        logits = net(x.permute(2, 0, 1)[None])
        logits = torch.nn.functional.interpolate(logits, (height, width), mode="bilinear")
        return logits.softmax(1)[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize("shrink", [1, 2, 4])
@pytest.mark.parametrize(
    "wrap", [None, *(pytest.param(name, marks=pytest.mark.slow) for name in ("state_dict", "model"))]
)
def test_a_torch_checkpoint_gives_the_saved_networks_probabilities(
    tmp_path: Path, shrink: int, wrap: str | None
) -> None:
    net = network()
    path = tmp_path / "net.pth"
    torch.save(net.state_dict() if wrap is None else {wrap: net.state_dict(), "epoch": 3}, path)
    segment = open_segmenter(f"refinenet:{path}?shrink={shrink}", URBAN, device="cpu")
    assert segment.class_names == KITTI6
    seen = segment(camera())
    np.testing.assert_allclose(seen, expected_probabilities(net, shrink), atol=1e-5)
    np.testing.assert_allclose(seen.sum(2), 1, atol=1e-5)


def test_a_safetensors_file_carries_its_own_class_names_and_scale(tmp_path: Path) -> None:
    names = (*URBAN.names, "other")
    write_network(tmp_path / "net.safetensors", network(), names, scale=0.5, half=False)
    segment = open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}", URBAN, device="cpu")
    assert segment.class_names == names
    assert segment(camera()).shape == (22, 41, 6)


def test_half_precision_changes_the_file_and_hardly_the_answer(tmp_path: Path) -> None:
    for name, half in (("full", False), ("half", True)):
        write_network(tmp_path / f"{name}.safetensors", network(), KITTI6, 1.0, half)
    full, half = (
        open_segmenter(f"refinenet:{tmp_path / name}.safetensors", URBAN, device="cpu")(camera())
        for name in ("full", "half")
    )
    assert np.abs(full - half).max() < 0.01
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (
        tmp_path / "full.safetensors"
    ).stat().st_size


@pytest.mark.parametrize("layout", [{}, {"depth_head": False}, {"single_task": True}, {"width": 40}])
def test_the_tensors_say_which_network_they_are_of(tmp_path: Path, layout: dict[str, Any]) -> None:
    net = network(**layout)
    torch.save(net.state_dict(), tmp_path / "net.pth")
    seen = open_segmenter(f"refinenet:{tmp_path / 'net.pth'}", URBAN, device="cpu")(camera())
    np.testing.assert_allclose(seen, expected_probabilities(net, 2), atol=1e-5)


def test_a_resnet_checkpoint_is_told_from_a_mobilenet_one(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = LightWeightRefineNet(19, "resnet50").eval()
    torch.save({f"module.{name}": t for name, t in net.state_dict().items()}, tmp_path / "net.pth")
    segment = open_segmenter(f"refinenet:{tmp_path / 'net.pth'}", URBAN, device="cpu")
    assert segment.class_names[:2] == ("road", "sidewalk")
    assert len(segment.class_names) == 19
    np.testing.assert_allclose(segment(camera()), expected_probabilities(net, 2), atol=1e-5)


def test_old_checkpoints_may_lack_the_batch_counters_and_nothing_else(tmp_path: Path) -> None:
    state = network().state_dict()
    old = {n: t for n, t in state.items() if not n.endswith("num_batches_tracked")}
    torch.save(old, tmp_path / "old.pth")
    open_segmenter(f"refinenet:{tmp_path / 'old.pth'}", URBAN)
    del old["layer4.0.output.1.1.running_mean"]
    torch.save(old, tmp_path / "older.pth")
    with pytest.raises(DataError, match=r"1 of 343 tensors missing.*running_mean"):
        open_segmenter(f"refinenet:{tmp_path / 'older.pth'}", URBAN)


class Spy:
    """Pickles to a call: a checkpoint that would run code."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_a_pickle_with_code_is_refused_and_not_run(tmp_path: Path) -> None:
    torch.save({"state_dict": network().state_dict(), "hook": Spy(tmp_path / "ran")}, tmp_path / "bad.pth")
    with pytest.raises(DataError, match=r"bad\.pth: damaged, or holds code"):
        open_segmenter(f"refinenet:{tmp_path / 'bad.pth'}", URBAN)
    assert not (tmp_path / "ran").exists()


def edited(change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    state = dict(network().state_dict())
    change(state)
    return state


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (edited(lambda s: s.update(surplus=torch.zeros(1))), r"1 of 343 tensors unknown, \['surplus'\]"),
        (edited(lambda s: s.update({"conv5.weight": torch.zeros(24, 65, 1, 1)})), "1 of 343 tensors of another shape"),
        (edited(lambda s: s["conv5.weight"].fill_(torch.nan)), "not finite"),
        (edited(lambda s: [s.pop(n) for n in list(s) if n.startswith("segm")]), "expected those of RefineNet"),
        ({"fc.weight": torch.zeros(2, 2)}, "expected those of RefineNet"),
        ([1, 2, 3], "found list"),
        ({"state_dict": {}}, "expected a state_dict"),
    ],
)  # fmt: skip
def test_a_checkpoint_that_does_not_fit_says_how(tmp_path: Path, content: Any, message: str) -> None:
    torch.save(content, tmp_path / "net.pth")
    with pytest.raises(DataError, match=message) as caught:
        open_segmenter(f"refinenet:{tmp_path / 'net.pth'}", URBAN)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["net.pth", "net.safetensors"])
@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04"])
def test_a_damaged_file_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=name):
        open_segmenter(f"refinenet:{tmp_path / name}", URBAN)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        open_segmenter(f"refinenet:{tmp_path / 'none.pth'}", URBAN)


@pytest.mark.parametrize(
    ("classes", "query", "message"),
    [
        (7, "", "7 classes without names"),
        (7, "?classes=cityscapes", "found 7 classes, and 19 names"),
        (6, "?classes=road,road,car,sky,tree", "found 6 classes, and 5 names"),
        (6, "?classes=raod,sidewalk,car,sky,tree,building", "did you mean 'road'"),
        (6, "?shrink=0", "shrink='0'"),
        (6, "?scale=nan", "scale='nan'"),
        (6, "?size=3", r"unknown options \['size'\]"),
    ],
)
def test_classes_and_options_that_do_not_fit_are_refused(
    tmp_path: Path, classes: int, query: str, message: str
) -> None:
    torch.save(network(classes).state_dict(), tmp_path / "net.pth")
    with pytest.raises(ConfigError, match=message):
        open_segmenter(f"refinenet:{tmp_path / 'net.pth'}{query}", URBAN)


def test_a_void_channel_gets_no_probability(tmp_path: Path) -> None:
    save_file(network(20).state_dict(), tmp_path / "net.safetensors")
    segment = open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}?classes=cityscapes,void", URBAN)
    assert len(segment.class_names) == 19
    np.testing.assert_allclose(segment(camera()).sum(2), 1, atol=1e-5)


@pytest.mark.parametrize(
    "pixels", [PIXELS[:, :, 0], PIXELS.astype(np.uint16), np.dstack([PIXELS, PIXELS[:, :, :1]]), PIXELS[:0]]
)
def test_grey_deep_and_empty_images_are_refused(tmp_path: Path, pixels: np.ndarray) -> None:
    save_file(network().state_dict(), tmp_path / "net.safetensors")
    segment = open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}", URBAN)
    with pytest.raises(DataError, match="image 5: found"):
        segment(camera(pixels, number=5))


def test_a_device_whose_memory_is_full_is_our_error() -> None:
    def full(*_: Any) -> Any:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    segment = NetworkSegmenter("net", full, ("road",), torch.device("cpu"), torch.from_numpy)
    with pytest.raises(DataError, match="memory is full; try fewer images at once"):
        segment(camera())


def test_a_device_that_is_not_there_is_a_wrong_setting(tmp_path: Path) -> None:
    save_file(network().state_dict(), tmp_path / "net.safetensors")
    with pytest.raises(ConfigError, match="device 'abacus'"):
        open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}", URBAN, device="abacus")
