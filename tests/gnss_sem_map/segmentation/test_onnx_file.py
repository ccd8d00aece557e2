"""ONNX files that torch exported, run by onnxruntime, against torch."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
onnx = pytest.importorskip("onnx", reason="needs the package onnx")

from onnx import TensorProto, helper  # noqa: E402

from gnss_sem_map.errors import ConfigError, DataError  # noqa: E402
from gnss_sem_map.labels.label_set import open_label_set  # noqa: E402
from gnss_sem_map.segmentation import open_segmenter  # noqa: E402
from gnss_sem_map.segmentation.checkpoints import write_network  # noqa: E402
from gnss_sem_map.segmentation.refinenet import LightWeightRefineNet  # noqa: E402
from gnss_sem_map.sensor_log import Image  # noqa: E402

URBAN = open_label_set("urban")
PIXELS = np.random.default_rng(2).integers(0, 256, (32, 64, 3), dtype=np.uint8)


def camera(pixels: np.ndarray = PIXELS) -> Image:
    return Image(0, 0.0, lambda: pixels)


def save(
    path: Path, weights: np.ndarray, size: tuple[object, object] = ("h", "w"), kind: str = "conv"
) -> Path:
    """A network of one 1x1 convolution with the (c, 3) weights; `kind` makes layouts that we must refuse."""
    count = len(weights)
    kernel = helper.make_tensor("k", TensorProto.FLOAT, (count, 3, 1, 1), weights.astype(np.float32).ravel())
    channels = 4 if kind == "four channels" else 3
    inputs = [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, channels, *size])]
    nodes = [helper.make_node("Conv", ["x", "k"], ["y"])]
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, count, *size])
    if kind == "argmax":
        nodes.append(helper.make_node("ArgMax", ["y"], ["ids"], axis=1))
        output = helper.make_tensor_value_info("ids", TensorProto.INT64, [1, 1, *size])
    if kind in ("Softmax", "Sigmoid"):
        nodes.append(helper.make_node(kind, ["y"], ["p"], **({"axis": 1} if kind == "Softmax" else {})))
        output = helper.make_tensor_value_info("p", TensorProto.FLOAT, [1, count, *size])
    if kind == "two inputs":
        inputs.append(helper.make_tensor_value_info("z", TensorProto.FLOAT, [1]))
    if kind == "four channels":
        kernel = helper.make_tensor("k", TensorProto.FLOAT, (count, 4, 1, 1), np.ones(4 * count, np.float32))
    graph = helper.make_graph(nodes, "net", inputs, [output], [kernel])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return path


WEIGHTS = np.random.default_rng(3).normal(size=(6, 3))


@pytest.mark.slow
def test_an_exported_refinenet_gives_what_torch_gives(tmp_path: Path) -> None:
    network = LightWeightRefineNet(6, "mobilenet_v2", width=16, depth_head=False).eval()
    names = ("road", "sidewalk", "car", "building", "vegetation", "sky")
    write_network(tmp_path / "net.safetensors", network, names, 1.0, half=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own
        torch.onnx.export(network, (torch.zeros(1, 3, 32, 64),), str(tmp_path / "net.onnx"), verbose=False)
    theirs = open_segmenter(f"onnx:{tmp_path / 'net.onnx'}?classes={','.join(names)}", URBAN, "cpu")
    ours = open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}", URBAN, "cpu")
    assert theirs.class_names == ours.class_names
    np.testing.assert_allclose(theirs(camera()), ours(camera()), atol=1e-4)


@pytest.mark.parametrize(
    ("query", "order", "mean", "std", "unit"),
    [
        ("", (0, 1, 2), (0.485, 0.456, 0.406), (0.229, 0.224, 0.225), 255),
        ("&order=bgr&mean=72,82,73&std=45,46,44&pixel_max=255", (2, 1, 0), (72, 82, 73), (45, 46, 44), 1),
    ],
)  # fmt: skip
def test_pixels_are_normalised_as_the_spec_says(
    tmp_path: Path,
    query: str,
    order: tuple[int, ...],
    mean: tuple[float, ...],
    std: tuple[float, ...],
    unit: float,
) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS)
    seen = open_segmenter(f"onnx:{path}?classes=kitti6&shrink=1{query}", URBAN, "cpu")(camera())
    logits = ((PIXELS[:, :, order] / unit - np.array(mean)) / np.array(std)) @ WEIGHTS.T
    expected = np.exp(logits) / np.exp(logits).sum(2, keepdims=True)
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_the_channel_called_void_is_dropped_before_the_softmax(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", np.random.default_rng(4).normal(size=(20, 3)))
    segment = open_segmenter(f"onnx:{path}?classes=cityscapes,void", URBAN, "cpu")
    assert len(segment.class_names) == 19
    np.testing.assert_allclose(segment(camera()).sum(2), 1, atol=1e-5)


def test_a_network_of_fixed_size_gets_any_image_at_that_size(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS, (16, 48))
    flat = np.full((45, 83, 3), 90, np.uint8)
    seen = open_segmenter(f"onnx:{path}?classes=kitti6", URBAN, "cpu")(camera(flat))
    assert seen.shape == (22, 41, 6)
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0, 0], seen.shape), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("argmax", "export the logits"),
        ("two inputs", "expected one of float"),
        ("four channels", r"expected one of float \(1, 3, height, width\)"),
    ],
)
def test_another_layout_is_refused_on_opening(tmp_path: Path, kind: str, message: str) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS, kind=kind)
    with pytest.raises(DataError, match=message):
        open_segmenter(f"onnx:{path}?classes=kitti6", URBAN, "cpu")


@pytest.mark.parametrize("content", [b"", b"no network", None])
def test_a_damaged_or_missing_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "net.onnx").write_bytes(content)
    with pytest.raises(DataError, match=r"net\.onnx: (cannot be read|no such file)"):
        open_segmenter(f"onnx:{tmp_path / 'net.onnx'}", URBAN, "cpu")


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("mean=1,2", "three numbers"),
        ("std=a,b,c", "three numbers"),
        ("std=1,0,1", "positive"),
        ("order=grb", "order grb"),
        ("pixel_max=2", "pixel_max 2"),
        ("classes=cityscapes", "found 6 classes"),
        ("size=4", r"unknown options \['size'\]"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path: Path, query: str, message: str) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS)
    with pytest.raises(ConfigError, match=message):
        open_segmenter(f"onnx:{path}?{query}", URBAN, "cpu")


def test_logits_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", np.where(WEIGHTS > 1, np.nan, WEIGHTS))
    with pytest.raises(DataError, match="not finite"):
        open_segmenter(f"onnx:{path}", URBAN, "cpu")(camera())


@pytest.mark.parametrize(
    ("kind", "more"), [("Softmax", ""), ("Softmax", "&shrink=1"), ("Sigmoid", "&shrink=1")]
)
def test_probabilities_that_a_network_gives_are_kept(tmp_path: Path, kind: str, more: str) -> None:
    """No second softmax; of a sigmoid for each class, the share of all."""
    plain, with_it = (save(tmp_path / f"{n}.onnx", WEIGHTS, kind=of) for n, of in enumerate(("conv", kind)))
    names = ",".join((*URBAN.names[:5], "sky"))
    ours, theirs = (
        open_segmenter(f"onnx:{path}?classes={names}{more}", URBAN, "cpu") for path in (plain, with_it)
    )
    if kind == "Softmax":
        np.testing.assert_allclose(theirs(camera()), ours(camera()), atol=1e-5)
    else:
        seen = (PIXELS / 255 - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
        alone = 1 / (1 + np.exp(-(seen @ WEIGHTS.T)))
        expected = alone / alone.sum(axis=2, keepdims=True)
        np.testing.assert_allclose(theirs(camera()), expected, atol=1e-4)
