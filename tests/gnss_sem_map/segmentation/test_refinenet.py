"""The networks have the tensors of the published checkpoints, and behave as convolutional networks must."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import pytest
import torch

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.segmentation.networks import for_inference
from gnss_sem_map.segmentation.refinenet import ChannelGains, LightWeightRefineNet, RefineNet


def shapes_of(build: Any, *args: Any, **layout: Any) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {name: tuple(t.shape) for name, t in build(*args, **layout).state_dict().items()}


@pytest.mark.parametrize(
    ("build", "classes", "backbone", "layout", "tensors", "millions"),
    [
        (RefineNet, 19, "resnet101", {}, 712, 118.05),
        (LightWeightRefineNet, 19, "resnet50", {}, 346, 27.35),
        (LightWeightRefineNet, 19, "resnet101", {}, 652, 46.35),
        (LightWeightRefineNet, 21, "resnet152", {}, 958, 61.99),
        (LightWeightRefineNet, 21, "mobilenet_v2", {"single_task": True}, 339, 3.28),
        (LightWeightRefineNet, 6, "mobilenet_v2", {}, 343, 2.99),
    ],
)
def test_every_network_has_as_many_tensors_and_parameters_as_the_published_one(
    build: Any, classes: int, backbone: str, layout: dict[str, Any], tensors: int, millions: float
) -> None:
    shapes = shapes_of(build, classes, backbone, **layout)
    assert len(shapes) == tensors
    counted = [s for name, s in shapes.items() if not re.search("running|num_batches", name)]
    assert sum(torch.Size(s).numel() for s in counted) / 1e6 == pytest.approx(millions, abs=0.005)


def decoder_on_resnet(kernel: int, classes: int) -> dict[str, tuple[int, ...]]:
    """The names and shapes of the published checkpoints' decoder, from their description."""
    k, table = (kernel, kernel), {}
    light = kernel == 1
    for stage, channels in ((1, 2048), (2, 1024), (3, 512), (4, 256)):
        width = 512 if stage == 1 else 256
        table[f"p_ims1d2_outl{stage}_dimred.weight"] = (width, channels, *k)
        for i in (1, 2, 3, 4):
            table[f"mflow_conv_g{stage}_pool.0.{i}_outvar_dimred.weight"] = (width, width, *k)
        for part, units in ((f"adapt_stage{stage}_b", 2), (f"mflow_conv_g{stage}_b", 3)):
            for i in range(1, 1 + (0 if light else units)):
                table[f"{part}.0.{i}_conv.weight"] = (width, width, 3, 3)
                table[f"{part}.0.{i}_conv.bias"] = (width,)
                table[f"{part}.0.{i}_conv_relu_varout_dimred.weight"] = (width, width, 3, 3)
        if stage > 1:
            table[f"adapt_stage{stage}_b2_joint_varout_dimred.weight"] = (256, 256, *k)
        if stage < 4:
            table[f"mflow_conv_g{stage}_b3_joint_varout_dimred.weight"] = (256, width, *k)
    return table | {"clf_conv.weight": (classes, 256, 3, 3), "clf_conv.bias": (classes,)}


@pytest.mark.parametrize(("build", "kernel"), [(RefineNet, 3), (LightWeightRefineNet, 1)])
@pytest.mark.parametrize("backbone", ["resnet50", "resnet101"])
def test_the_decoder_on_resnet_has_the_published_names_and_shapes(
    build: Any, kernel: int, backbone: str
) -> None:
    shapes = shapes_of(build, 19, backbone)
    trunk = re.compile(r"(conv1|bn1|layer[1-4]\.\d+\.(conv[123]|bn[123]|downsample\.[01]))\.")
    assert {n: s for n, s in shapes.items() if not trunk.match(n)} == decoder_on_resnet(kernel, 19)
    assert shapes["conv1.weight"] == (64, 3, 7, 7)
    assert shapes["layer3.1.conv1.weight"] == (256, 1024, 1, 1)
    assert shapes["layer4.0.downsample.0.weight"] == (2048, 1024, 1, 1)
    blocks = Counter(n.split(".")[0] for n in shapes if n.endswith("conv2.weight"))
    assert blocks == {"layer1": 3, "layer2": 4, "layer3": 6 if backbone == "resnet50" else 23, "layer4": 3}


def decoder_on_mobilenet(classes: int, single_task: bool) -> dict[str, tuple[int, ...]]:
    channels = {8: 320, 7: 160, 6: 96, 5: 64, 4: 32, 3: 24}
    table = {f"conv{layer}.weight": (256, c, 1, 1) for layer, c in channels.items()}
    for stage in (1, 2, 3, 4):
        inputs = 1 if stage == 1 and not single_task else 256
        for i in (1, 2, 3, 4):
            table[f"crp{stage}.0.{i}_outvar_dimred.weight"] = (256, inputs, 1, 1)
    table |= {f"conv_adapt{stage}.weight": (256, 256, 1, 1) for stage in (4, 3, 2)}
    heads = {"segm": classes} if single_task else {"segm": classes, "depth": 1}
    for head, out in heads.items():
        table |= {f"{head}.weight": (out, 256, 3, 3), f"{head}.bias": (out,)}
        if not single_task:
            table[f"pre_{head}.weight"] = (256, 1, 1, 1)
    return table


@pytest.mark.parametrize("single_task", [False, True])
def test_the_decoder_on_mobilenet_has_the_published_names_and_shapes(single_task: bool) -> None:
    shapes = shapes_of(LightWeightRefineNet, 6, "mobilenet_v2", single_task=single_task)
    trunk = re.compile(r"layer1\.[01]\.|layer[2-8]\.\d\.output\.[012]\.[01]\.")
    assert {n: s for n, s in shapes.items() if not trunk.match(n)} == decoder_on_mobilenet(6, single_task)
    assert shapes["layer1.0.weight"] == (32, 3, 3, 3)
    assert shapes["layer2.0.output.0.0.weight"] == (32, 32, 1, 1)  # expanded by one: still there
    assert shapes["layer3.1.output.1.0.weight"] == (144, 1, 3, 3)
    assert shapes["layer8.0.output.2.0.weight"] == (320, 960, 1, 1)
    blocks = Counter(n.split(".")[0] for n in shapes if n.endswith("output.1.0.weight"))
    assert [blocks[f"layer{i}"] for i in range(2, 9)] == [1, 2, 3, 4, 3, 3, 1]


SMALL = [
    (RefineNet, "resnet50", {}),
    (LightWeightRefineNet, "resnet50", {}),
    (LightWeightRefineNet, "mobilenet_v2", {}),
    (LightWeightRefineNet, "mobilenet_v2", {"single_task": True}),
    (LightWeightRefineNet, "mobilenet_v2", {"width": 24, "depth_head": False}),
]


@pytest.mark.parametrize(("build", "backbone", "layout"), SMALL)
@pytest.mark.parametrize(
    "size",
    [
        (47, 61),
        pytest.param((64, 96), marks=pytest.mark.slow),
        pytest.param((33, 130), marks=pytest.mark.slow),
    ],
)
def test_logits_come_at_a_quarter_of_any_image_size(
    build: Any, backbone: str, layout: dict[str, Any], size: tuple[int, int]
) -> None:
    network = build(5, backbone, **layout).eval()
    with torch.inference_mode():
        logits = network(torch.randn(1, 3, *size))
    assert logits.shape == (1, 5, -(-size[0] // 4), -(-size[1] // 4))
    assert torch.isfinite(logits).all()


@pytest.mark.parametrize(("build", "backbone", "layout"), SMALL)
def test_an_image_gets_the_same_logits_alone_and_in_company(
    build: Any, backbone: str, layout: dict[str, Any]
) -> None:
    network = build(5, backbone, **layout).eval()
    images = torch.randn(3, 3, 40, 56)
    with torch.inference_mode():
        together = network(images)
        alone = torch.cat([network(image[None]) for image in images])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4 * float(together.abs().max()))


@pytest.mark.slow
@pytest.mark.parametrize(("build", "backbone", "layout"), SMALL)
def test_every_parameter_that_the_logits_depend_on_gets_a_gradient(
    build: Any, backbone: str, layout: dict[str, Any]
) -> None:
    network = build(5, backbone, **layout).train()
    network(torch.randn(2, 3, 70, 70)).square().mean().backward()
    without = {n for n, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    heads = {"pre_depth.weight", "depth.weight", "depth.bias"}  # the other task's
    assert without <= heads


def test_moving_the_image_by_a_stride_moves_the_logits() -> None:
    network = LightWeightRefineNet(5, "mobilenet_v2", width=32).eval()
    wide = torch.randn(1, 3, 64, 64 + 512 + 32)
    with torch.inference_mode():
        first, second = network(wide[..., :-32]), network(wide[..., 32:])
    middle = first.shape[-1] // 2
    torch.testing.assert_close(second[..., middle], first[..., middle + 8], rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_a_network_that_is_told_its_classes_learns_one_picture() -> None:
    network = LightWeightRefineNet(3, "mobilenet_v2", width=24, depth_head=False).train()
    images = torch.zeros(2, 3, 64, 96)
    truth = (torch.arange(24) // 8).expand(2, 16, 24)
    for k in range(3):
        images[:, k, :, 32 * k : 32 * k + 32] = 1.0
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(25):
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(network(images), truth)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]


def test_depth_is_never_negative_and_needs_its_head() -> None:
    network = LightWeightRefineNet(6, "mobilenet_v2").eval()
    with torch.inference_mode():
        depth = network.depth_m(torch.randn(1, 3, 33, 47))
    assert depth.shape == (1, 1, 9, 12)
    assert (depth >= 0).all()


def test_an_unknown_backbone_is_answered_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="resnet101"):
        RefineNet(19, "vgg16")
    with pytest.raises(ConfigError, match="resnet101"):
        LightWeightRefineNet(19, "vgg16")
    with pytest.raises(ConfigError, match="width"):
        LightWeightRefineNet(19, "resnet50", width=64)


def test_gains_per_channel_are_the_grouped_convolution_of_the_checkpoints() -> None:
    gains, grouped = ChannelGains(7), torch.nn.Conv2d(7, 7, 1, groups=7, bias=False)
    gains.load_state_dict(grouped.state_dict())
    x = torch.randn(2, 7, 5, 3)
    torch.testing.assert_close(gains(x), grouped(x))


@pytest.mark.parametrize(
    ("backbone", "layout"), [("resnet50", {}), ("mobilenet_v2", {"width": 32, "depth_head": False})]
)
def test_a_network_ready_for_inference_says_the_same_and_normalises_nowhere(
    backbone: str, layout: dict[str, Any]
) -> None:
    torch.manual_seed(0)
    network = LightWeightRefineNet(5, backbone, **layout)
    images = torch.rand(2, 3, 70, 90)
    network.train()(images)  # so that the running means and variances are not those of the beginning
    network.eval()
    with torch.inference_mode():
        expected = network(images)
        found = for_inference(network, torch.device("cpu"))(images)
    assert not [m for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    assert expected.std() > 1e-3
    assert torch.allclose(found, expected, atol=1e-4 * float(expected.abs().max()))
