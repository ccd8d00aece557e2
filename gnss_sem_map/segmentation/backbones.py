"""ResNet and MobileNet-v2 as feature pyramids, with the tensor names of their checkpoints."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

RESNET_BLOCKS = {"resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3), "resnet152": (3, 8, 36, 3)}

INVERTED_RESIDUALS = (
    (1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1),
)  # fmt: skip
"""Expansion, channels, repetitions and first stride of every stage (Sandler et al., CVPR 2018, table 2)."""


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolution beside a shortcut; the stride is in the 3x3 (He et al., CVPR 2016, as published)."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = 4 * width
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out)
            )

    def forward(self, x: Tensor) -> Tensor:
        """(b, channels, h, w) -> (b, 4 width, ceil(h / stride), ceil(w / stride))."""
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        shortcut = x if self.downsample is None else self.downsample(x)
        return torch.relu(self.bn3(self.conv3(y)) + shortcut)


class ResNet(nn.Module):
    """A ResNet without its classifier, with 50, 101 or 152 layers."""

    CHANNELS = (256, 512, 1024, 2048)
    """Of `pyramid`, at strides 4, 8, 16 and 32."""

    def __init__(self, blocks: tuple[int, ...]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = _bottlenecks(64, 64, blocks[0], 1)
        self.layer2 = _bottlenecks(256, 128, blocks[1], 2)
        self.layer3 = _bottlenecks(512, 256, blocks[2], 2)
        self.layer4 = _bottlenecks(1024, 512, blocks[3], 2)

    def pyramid(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features of (b, 3, h, w) images at strides 4, 8, 16 and 32."""
        stem = torch.relu(self.bn1(self.conv1(images)))
        l1 = self.layer1(nn.functional.max_pool2d(stem, 3, 2, 1))
        l2 = self.layer2(l1)
        l3 = self.layer3(l2)
        return l1, l2, l3, self.layer4(l3)


def _bottlenecks(channels: int, width: int, count: int, stride: int) -> nn.Sequential:
    rest = (Bottleneck(4 * width, width, 1) for _ in range(count - 1))
    return nn.Sequential(Bottleneck(channels, width, stride), *rest)


class InvertedResidual(nn.Module):
    """Expand, filter each channel, project; a shortcut where the shapes agree (Sandler et al., section 3.3)."""

    def __init__(self, channels: int, out: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = expansion * channels
        self.shortcut = stride == 1 and channels == out
        self.output = nn.Sequential(
            nn.Sequential(
                nn.Conv2d(channels, wide, 1, bias=False), nn.BatchNorm2d(wide), nn.ReLU6(inplace=True)
            ),
            nn.Sequential(
                nn.Conv2d(wide, wide, 3, stride, 1, groups=wide, bias=False),
                nn.BatchNorm2d(wide),
                nn.ReLU6(inplace=True),
            ),
            nn.Sequential(nn.Conv2d(wide, out, 1, bias=False), nn.BatchNorm2d(out)),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(b, channels, h, w) -> (b, out, ceil(h / stride), ceil(w / stride))."""
        y: Tensor = self.output(x)
        return x + y if self.shortcut else y


class MobileNetV2(nn.Module):
    """MobileNet-v2 without its classifier: `layer1` is the stem, `layer2` to `layer8` are INVERTED_RESIDUALS."""

    CHANNELS = tuple(channels for _, channels, _, _ in INVERTED_RESIDUALS[1:])
    """Of `pyramid`: 24, 32, 64, 96, 160, 320."""

    def __init__(self) -> None:
        super().__init__()
        self.layer1 = nn.Sequential(
            nn.Conv2d(3, 32, 3, 2, 1, bias=False), nn.BatchNorm2d(32), nn.ReLU6(inplace=True)
        )
        channels = 32
        for number, (expansion, out, count, stride) in enumerate(INVERTED_RESIDUALS, start=2):
            widths = (channels, *([out] * count))
            blocks = (
                InvertedResidual(a, b, stride if i == 0 else 1, expansion)
                for i, (a, b) in enumerate(pairwise(widths))
            )
            self.add_module(f"layer{number}", nn.Sequential(*blocks))
            channels = out

    def pyramid(self, images: Tensor) -> tuple[Tensor, ...]:
        """Features of layers 3 to 8 of (b, 3, h, w) images, at strides 4, 8, 16, 16, 32, 32."""
        x = self.get_submodule("layer2")(self.layer1(images))
        features = []
        for number in range(3, 9):
            x = self.get_submodule(f"layer{number}")(x)
            features.append(x)
        return tuple(features)
