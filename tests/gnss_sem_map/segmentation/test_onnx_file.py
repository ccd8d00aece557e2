"""ONNX files that torch exported, run by onnxruntime, against torch."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

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
from gnss_sem_map.segmentation.onnx_file import PROBE  # noqa: E402
from gnss_sem_map.segmentation.refinenet import LightWeightRefineNet  # noqa: E402
from gnss_sem_map.sensor_log import Image  # noqa: E402

URBAN = open_label_set("urban")
PIXELS = np.random.default_rng(2).integers(0, 256, (32, 64, 3), dtype=np.uint8)


def camera(pixels: np.ndarray = PIXELS) -> Image:
    return Image(0, 0.0, lambda: pixels)


LAYOUT = {"NCHW": [0, 1, 2, 3], "NHWC": [0, 2, 3, 1]}
FLOATS = {"float16": TensorProto.FLOAT16, "float32": TensorProto.FLOAT, "float64": TensorProto.DOUBLE}


def save(
    path: Path,
    weights: np.ndarray,
    size: tuple[object, object] = ("h", "w"),
    kind: str = "conv",
    layouts: tuple[str, str] = ("NCHW", "NCHW"),
    dtype: str = "float32",
    batch: object = 1,
) -> Path:
    """A network of one 1x1 convolution with the (c, 3) weights, in any layout and type, and what `kind` adds to it."""
    count, number = len(weights), FLOATS[dtype]
    channels = 4 if kind == "four channels" else 3
    weights = np.ones((count, 4)) if kind == "four channels" else weights
    kernel = helper.make_tensor(
        "k", TensorProto.FLOAT, (count, channels, 1, 1), weights.astype(np.float32).ravel()
    )
    dims = [[batch, channels, *size][i] for i in LAYOUT[layouts[0]]]
    dims = ["b", *(f"{of}_1" for of in layouts[0][1:])] if size == "symbolic" else dims
    inputs = [helper.make_tensor_value_info("pixels", TensorProto.UINT8 if kind == "uint8" else number, dims)]
    nodes = [
        helper.make_node("Cast", ["pixels"], ["cast"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["cast"], ["x"], perm=[0, 3, 1, 2] if layouts[0] == "NHWC" else [0, 1, 2, 3]),
        helper.make_node("Conv", ["x", "k"], ["y"]),
    ]  # fmt: skip
    last, of = "y", number
    if kind in ("Softmax", "Sigmoid"):
        nodes.append(helper.make_node(kind, ["y"], ["p"], **({"axis": 1} if kind == "Softmax" else {})))
        last = "p"
    if kind.startswith("argmax"):
        keep = int("keep" in kind)
        nodes.append(helper.make_node("ArgMax", ["y"], ["ids"], axis=1, keepdims=keep))
        of = (
            TensorProto.FLOAT
            if "float" in kind
            else TensorProto.INT32
            if "int32" in kind
            else TensorProto.INT64
        )
        last = "ids"
    if not kind.startswith("argmax"):
        nodes.append(helper.make_node("Transpose", [last], ["t"], perm=LAYOUT[layouts[1]]))
        last = "t"
    nodes.append(helper.make_node("Cast", [last], ["answer"], to=of))
    outputs = [helper.make_tensor_value_info("answer", of, None)]
    if kind == "two outputs":
        nodes.append(helper.make_node("ReduceMean", ["y"], ["feature"], keepdims=0, axes=[2, 3]))
        outputs.insert(0, helper.make_tensor_value_info("feature", TensorProto.FLOAT, None))
    if kind == "ids and logits":
        nodes.append(helper.make_node("ArgMax", ["y"], ["ids"], axis=1, keepdims=0))
        outputs.insert(0, helper.make_tensor_value_info("ids", TensorProto.INT64, None))
    if kind == "one size inside":
        nodes[2:3] = [
            helper.make_node("Conv", ["x", "k"], ["z"]),
            helper.make_node("Add", ["z", "noise"], ["y"]),
        ]
    if kind == "two inputs":
        inputs.append(helper.make_tensor_value_info("z", TensorProto.FLOAT, [1]))
    if kind == "no image":
        nodes.append(helper.make_node("ReduceMean", ["y"], ["mean"], keepdims=0, axes=[1, 2, 3]))
        outputs = [helper.make_tensor_value_info("mean", TensorProto.FLOAT, None)]
    constants = [kernel]
    if kind == "one size inside":
        shape = (1, count, *PROBE)
        constants.append(helper.make_tensor("noise", TensorProto.FLOAT, shape, np.zeros(np.prod(shape))))
    graph = helper.make_graph(nodes, "net", inputs, outputs, constants)
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


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", [("h", "w"), (32, 64), (None, None), "symbolic", (32, "w")])
@pytest.mark.parametrize("layouts", [("NCHW", "NCHW"), ("NHWC", "NHWC"), ("NHWC", "NCHW")])
def test_any_layout_type_and_names_of_axes_give_the_same(
    tmp_path: Path, layouts: tuple[str, str], size: Any, dtype: str
) -> None:
    plain = open_segmenter(f"onnx:{save(tmp_path / 'a.onnx', WEIGHTS)}", URBAN, "cpu")(camera())
    path = save(tmp_path / "b.onnx", WEIGHTS, size, layouts=layouts, dtype=dtype)
    seen = open_segmenter(f"onnx:{path}", URBAN, "cpu")(camera())
    np.testing.assert_allclose(seen, plain, atol=3e-3 if dtype == "float16" else 1e-5)


@pytest.mark.parametrize("count", [6, 19, 64, 150])
def test_the_axis_of_the_classes_is_found_whatever_their_number(tmp_path: Path, count: int) -> None:
    weights = np.random.default_rng(7).normal(size=(count, 3))
    names = ",".join(["road", "sidewalk", "car"] * count)[:-1].split(",")[:count]
    answers = []
    for layouts in (("NCHW", "NCHW"), ("NHWC", "NHWC")):
        path = save(tmp_path / f"{layouts[0]}.onnx", weights, (64, 64), layouts=layouts)
        answers.append(open_segmenter(f"onnx:{path}?classes={','.join(names)}", URBAN, "cpu")(camera()))
    assert answers[0].shape[2] == count
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-5)


@pytest.mark.parametrize("kind", ["two outputs", "ids and logits"])
def test_of_several_outputs_that_of_the_logits_is_taken(tmp_path: Path, kind: str) -> None:
    plain = open_segmenter(f"onnx:{save(tmp_path / 'a.onnx', WEIGHTS)}", URBAN, "cpu")(camera())
    seen = open_segmenter(f"onnx:{save(tmp_path / 'b.onnx', WEIGHTS, kind=kind)}", URBAN, "cpu")(camera())
    np.testing.assert_allclose(seen, plain, atol=1e-6)


@pytest.mark.parametrize(
    "kind", ["argmax", "argmax keep", "argmax int32", "argmax float", "argmax keep float"]
)
def test_class_ids_become_the_probabilities_of_label_images(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS, kind=kind)
    with pytest.raises(
        ConfigError, match=r"found ids of classes without names; name them with \?classes=cityscapes"
    ):
        open_segmenter(f"onnx:{path}", URBAN, "cpu")
    plain = open_segmenter(f"onnx:{save(tmp_path / 'a.onnx', WEIGHTS)}?shrink=1", URBAN, "cpu")(camera())
    seen = open_segmenter(f"onnx:{path}?classes=kitti6&shrink=1", URBAN, "cpu")(camera())
    np.testing.assert_array_equal(seen.argmax(2), plain.argmax(2))
    np.testing.assert_allclose(np.sort(seen, 2), np.broadcast_to([0.02] * 5 + [0.9], seen.shape), atol=1e-6)


def test_ids_of_void_and_ids_beyond_the_names_have_no_class(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS, kind="argmax")
    plain = open_segmenter(f"onnx:{save(tmp_path / 'a.onnx', WEIGHTS)}?shrink=1", URBAN, "cpu")(camera())
    seen = open_segmenter(f"onnx:{path}?classes=road,void,car,building&shrink=1", URBAN, "cpu")(camera())
    assert seen.shape[2] == 3
    np.testing.assert_array_equal(seen.any(2), np.isin(plain.argmax(2), [0, 2, 3]))


def test_an_input_of_bytes_gets_the_pixels(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS / 100, kind="uint8")
    seen = open_segmenter(f"onnx:{path}?shrink=1", URBAN, "cpu")(camera())
    logits = PIXELS @ WEIGHTS.T / 100
    expected = np.exp(logits) / np.exp(logits).sum(2, keepdims=True)
    np.testing.assert_allclose(seen, expected, atol=1e-4)


@pytest.mark.parametrize("batch", [1, 4, "batch"])
def test_a_network_of_any_batch_takes_one_image(tmp_path: Path, batch: object) -> None:
    plain = open_segmenter(f"onnx:{save(tmp_path / 'a.onnx', WEIGHTS)}", URBAN, "cpu")(camera())
    path = save(tmp_path / "b.onnx", WEIGHTS, batch=batch)
    np.testing.assert_allclose(open_segmenter(f"onnx:{path}", URBAN, "cpu")(camera()), plain, atol=1e-6)


class UNet(torch.nn.Module):
    """Its halves fit together only where sides are multiples of 32."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = torch.nn.Conv2d(3, 6, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        small = torch.nn.functional.avg_pool2d(x, 32)
        whole = torch.nn.functional.interpolate(small, scale_factor=32.0)
        return self.conv(torch.cat([x[:, :1], whole[:, 1:]], 1))


@pytest.mark.parametrize("shape", [(45, 83), (61, 200)])
def test_a_network_that_needs_whole_strides_gets_them(tmp_path: Path, shape: tuple[int, int]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            UNet(), (torch.zeros(1, 3, 64, 64),), str(tmp_path / "u.onnx"), verbose=False, dynamo=False,
            input_names=["image"], dynamic_axes={"image": {2: "height", 3: "width"}},
        )  # fmt: skip
    pixels = np.random.default_rng(8).integers(0, 256, (*shape, 3), dtype=np.uint8)
    seen = open_segmenter(f"onnx:{tmp_path / 'u.onnx'}", URBAN, "cpu")(camera(pixels))
    assert seen.shape == (shape[0] // 2, shape[1] // 2, 6)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("two inputs", "expected one: float"),
        ("four channels", r"expected one: float \(1, 3, h, w\)"),
        ("no image", r"found outputs .*'mean'.*, expected float \(1, classes, h, w\)"),
    ],
)
def test_another_layout_is_refused_on_opening(tmp_path: Path, kind: str, message: str) -> None:
    path = save(tmp_path / "net.onnx", WEIGHTS, kind=kind)
    with pytest.raises(DataError, match=message):
        open_segmenter(f"onnx:{path}?classes=kitti6", URBAN, "cpu")


def test_an_error_inside_names_network_image_and_size(tmp_path: Path) -> None:
    """It adds a plane of the size that it is tried with on opening, and no other image has."""
    path = save(tmp_path / "net.onnx", WEIGHTS, kind="one size inside")
    segment = open_segmenter(f"onnx:{path}?classes=kitti6&shrink=1", URBAN, "cpu")
    with pytest.raises(DataError, match=rf"onnx:{path} on image 0 of 64 x 32 pixels: ") as caught:
        segment(camera())
    assert "\n" not in str(caught.value)


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
        ("std=1,0,1", "above 0"),
        ("order=grb", "order='grb'"),
        ("pixel_max=2", "pixel_max='2'"),
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
