"""RefineNet and Light-Weight RefineNet, written from the papers, with the tensor names of the published checkpoints.

Lin et al., "RefineNet", CVPR 2017; Nekrasov et al., "Light-Weight RefineNet", BMVC 2018, and "Real-Time Joint
Semantic Segmentation and Depth Estimation", ICRA 2019. Every network takes RGB images (b, 3, h, w), scaled to 0..1 and
normalised with MEAN and STD, and gives class logits (b, c, ceil(h / 4), ceil(w / 4)).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, relu, relu6

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.segmentation.backbones import RESNET_BLOCKS, MobileNetV2, ResNet

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
"""Of ImageNet, which every published backbone was trained on."""

POOLINGS = 4
COMMON_WIDTH = 256
COARSEST_WIDTH = 512


def RefineNet(num_classes: int, backbone: str = "resnet101") -> ResNetRefineNet:
    """RefineNet on resnet50, resnet101 or resnet152; raises ConfigError for another backbone."""
    return ResNetRefineNet(num_classes, backbone, light_weight=False)


def LightWeightRefineNet(
    num_classes: int, backbone: str = "resnet50", **layout: Any
) -> ResNetRefineNet | MobileNetRefineNet:
    """Light-Weight RefineNet on a ResNet, or on mobilenet_v2 with the `layout` of MobileNetRefineNet.

    By default the network on mobilenet_v2 is that of the published KITTI checkpoint, with its depth head. Raises
    ConfigError for another backbone.
    """
    if backbone == "mobilenet_v2":
        return MobileNetRefineNet(num_classes, **layout)
    if layout:
        raise ConfigError(f"Light-Weight RefineNet on {backbone}: {sorted(layout)} are of mobilenet_v2")
    return ResNetRefineNet(num_classes, backbone, light_weight=True)


class ChannelGains(nn.Module):
    """One factor per channel: equals a 1x1 convolution with one group per channel, at less cost."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(width, 1, 1, 1).uniform_(-1.0, 1.0))

    def forward(self, x: Tensor) -> Tensor:
        """(b, width, h, w) -> the same shape."""
        return x * self.weight.reshape(1, -1, 1, 1)


def _pooled(x: Tensor) -> Tensor:
    """The maximum of 5 by 5 pixels: of rows, then of columns, in two thirds of the time on a CPU."""
    return max_pool2d(max_pool2d(x, (1, 5), 1, (0, 2)), (5, 1), 1, (2, 0))


class ChainedPooling(nn.Module):
    """Pool, convolve, add, each time on the last result: context from ever wider windows (Lin et al., fig. 3d)."""

    def __init__(self, width: int, kernel: int, channelwise: bool = False) -> None:
        super().__init__()
        self.convolutions = [f"{i}_outvar_dimred" for i in range(1, POOLINGS + 1)]
        for name in self.convolutions:
            self.add_module(name, ChannelGains(width) if channelwise else _convolution(width, width, kernel))

    def forward(self, x: Tensor) -> Tensor:
        """(b, width, h, w), already rectified -> the same shape."""
        link = x
        for name in self.convolutions:
            link = self.get_submodule(name)(_pooled(link))
            x = x + link
        return x


class ResidualUnits(nn.Module):
    """Units of two rectified 3x3 convolutions beside a shortcut, without normalisation (Lin et al., fig. 3b)."""

    def __init__(self, width: int, units: int) -> None:
        super().__init__()
        self.units = [(f"{i}_conv", f"{i}_conv_relu_varout_dimred") for i in range(1, units + 1)]
        for first, second in self.units:
            self.add_module(first, nn.Conv2d(width, width, 3, 1, 1, bias=True))
            self.add_module(second, nn.Conv2d(width, width, 3, 1, 1, bias=False))

    def forward(self, x: Tensor) -> Tensor:
        """(b, width, h, w) -> the same shape."""
        for first, second in self.units:
            x = x + self.get_submodule(second)(relu(self.get_submodule(first)(relu(x))))
        return x


class ResNetRefineNet(ResNet):
    """Four refinement stages, from the coarsest features to the finest, each adds the next finer ones.

    The light-weight kind has 1x1 convolutions and no residual units. Raises ConfigError for an unknown backbone.
    """

    def __init__(self, num_classes: int, backbone: str, light_weight: bool) -> None:
        if backbone not in RESNET_BLOCKS:
            raise ConfigError(f"RefineNet: unknown backbone {backbone!r}; expected {list(RESNET_BLOCKS)}")
        super().__init__(RESNET_BLOCKS[backbone])
        kernel = 1 if light_weight else 3
        widths = (COARSEST_WIDTH, COMMON_WIDTH, COMMON_WIDTH, COMMON_WIDTH)
        for stage, (channels, width) in enumerate(zip(reversed(self.CHANNELS), widths, strict=True), start=1):
            self.add_module(f"p_ims1d2_outl{stage}_dimred", _convolution(channels, width, kernel))
            self.add_module(f"adapt_stage{stage}_b", _residual_units(width, 2, light_weight))
            self.add_module(f"mflow_conv_g{stage}_pool", nn.Sequential(ChainedPooling(width, kernel)))
            self.add_module(f"mflow_conv_g{stage}_b", _residual_units(width, 3, light_weight))
            if stage > 1:
                self.add_module(
                    f"adapt_stage{stage}_b2_joint_varout_dimred", _convolution(width, width, kernel)
                )
            if stage < 4:
                self.add_module(
                    f"mflow_conv_g{stage}_b3_joint_varout_dimred", _convolution(width, COMMON_WIDTH, kernel)
                )
        self.drop_features = nn.Dropout(0.5)
        self.drop_last = nn.Identity() if light_weight else nn.Dropout(0.5)
        self.clf_conv = nn.Conv2d(COMMON_WIDTH, num_classes, 3, 1, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Normalised images (b, 3, h, w) -> logits (b, c, ceil(h / 4), ceil(w / 4))."""
        l1, l2, l3, l4 = self.pyramid(images)
        refined = self._refine(1, self.drop_features(l4), None)
        refined = self._refine(2, self.drop_features(l3), refined)
        refined = self._refine(3, l2, refined)
        refined = self._refine(4, l1, refined)
        logits: Tensor = self.clf_conv(self.drop_last(refined))
        return logits

    def _refine(self, stage: int, features: Tensor, coarser: Tensor | None) -> Tensor:
        part = self.get_submodule
        x: Tensor = part(f"adapt_stage{stage}_b")(part(f"p_ims1d2_outl{stage}_dimred")(features))
        if coarser is not None:
            coarser = part(f"mflow_conv_g{stage - 1}_b3_joint_varout_dimred")(coarser)
            x = part(f"adapt_stage{stage}_b2_joint_varout_dimred")(x) + _enlarge(
                coarser, x, align_corners=True
            )
        refined: Tensor = part(f"mflow_conv_g{stage}_b")(part(f"mflow_conv_g{stage}_pool")(relu(x)))
        return refined


class MobileNetRefineNet(MobileNetV2):
    """Light-Weight RefineNet on MobileNet-v2: six feature maps joined in four stages.

    `width` is the decoder's. The multi-task kind (the published KITTI network) pools the last stage channel by channel,
    may have a depth head, and enlarges with pixel edges aligned; `single_task` is the older kind, with corners aligned
    and neither. Mixing them up costs accuracy and raises nothing, hence the two names.
    """

    def __init__(
        self, num_classes: int, width: int = COMMON_WIDTH, depth_head: bool = True, single_task: bool = False
    ) -> None:
        super().__init__()
        self.single_task = single_task
        for layer, channels in enumerate(self.CHANNELS, start=3):
            self.add_module(f"conv{layer}", _convolution(channels, width, 1))
        for stage in (4, 3, 2):
            self.add_module(f"crp{stage}", nn.Sequential(ChainedPooling(width, 1)))
            self.add_module(f"conv_adapt{stage}", _convolution(width, width, 1))
        self.crp1 = nn.Sequential(ChainedPooling(width, 1, channelwise=not single_task))
        heads = {"segm": num_classes, "depth": 1} if depth_head and not single_task else {"segm": num_classes}
        for head, channels in heads.items():
            if not single_task:
                self.add_module(f"pre_{head}", ChannelGains(width))
            self.add_module(head, nn.Conv2d(width, channels, 3, 1, 1))

    def forward(self, images: Tensor) -> Tensor:
        """Normalised images (b, 3, h, w) -> logits (b, c, ceil(h / 4), ceil(w / 4))."""
        return self._head("segm", self._decode(images))

    def depth_m(self, images: Tensor) -> Tensor:
        """Depth (b, 1, ceil(h / 4), ceil(w / 4)) of a network that has the head, m."""
        return self._head("depth", self._decode(images)).abs()

    def _decode(self, images: Tensor) -> Tensor:
        part = self.get_submodule
        l3, l4, l5, l6, l7, l8 = self.pyramid(images)
        x = relu6(part("conv8")(l8) + part("conv7")(l7))
        x = relu6(part("conv5")(l5) + part("conv6")(l6) + self._carry(4, x, l6))
        x = relu6(part("conv4")(l4) + self._carry(3, x, l4))
        x = relu6(part("conv3")(l3) + self._carry(2, x, l3))
        refined: Tensor = self.crp1(x)
        return refined

    def _carry(self, stage: int, x: Tensor, finer: Tensor) -> Tensor:
        x = self.get_submodule(f"conv_adapt{stage}")(self.get_submodule(f"crp{stage}")(x))
        return _enlarge(x, finer, align_corners=self.single_task)

    def _head(self, name: str, x: Tensor) -> Tensor:
        if not self.single_task:
            x = relu6(self.get_submodule(f"pre_{name}")(x))
        prediction: Tensor = self.get_submodule(name)(x)
        return prediction


def _convolution(channels: int, out: int, kernel: int) -> nn.Conv2d:
    return nn.Conv2d(channels, out, kernel, padding=kernel // 2, bias=False)


def _residual_units(width: int, units: int, light_weight: bool) -> nn.Module:
    return nn.Identity() if light_weight else nn.Sequential(ResidualUnits(width, units))


def _enlarge(x: Tensor, finer: Tensor, align_corners: bool) -> Tensor:
    return interpolate(x, size=finer.shape[2:], mode="bilinear", align_corners=align_corners)
