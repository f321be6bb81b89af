"""Residual networks (He et al., "Deep Residual Learning", 2016) as feature extractors, with torchvision's names."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

DEPTHS = {
    "resnet18": (2, 2, 2, 2),
    "resnet34": (3, 4, 6, 3),
    "resnet50": (3, 4, 6, 3),
    "resnet101": (3, 4, 23, 3),
}
WITH_BOTTLENECKS = ("resnet50", "resnet101")
EXPANSION = 4  # of a bottleneck: channels out for each channel inside


@dataclass(frozen=True)
class ResNetShape:
    """What tells one residual network from another."""

    name: str = "resnet50"  # a key of DEPTHS
    width: int = 64  # channels of the stem; 64 in the paper
    stride_in_1x1: bool = False  # where a bottleneck halves the image: in its first convolution (the paper, Detectron's
    # networks) or in its second one (torchvision, "v1.5")
    norm_eps: float = 1e-5  # of the batch normalization

    @property
    def channels(self) -> tuple[int, ...]:
        """Of the four levels."""
        factor = EXPANSION if self.name in WITH_BOTTLENECKS else 1
        return tuple(self.width * 2**level * factor for level in range(4))


class ResNet(nn.Module):
    """The levels C2 to C5 of a residual network, of strides 4, 8, 16 and 32."""

    def __init__(self, shape: ResNetShape) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, shape.width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(shape.width, shape.norm_eps)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = (shape.width, *shape.channels)
        self.layer1 = _layer(channels[0], channels[1], 1, DEPTHS[shape.name][0], shape)
        self.layer2 = _layer(channels[1], channels[2], 2, DEPTHS[shape.name][1], shape)
        self.layer3 = _layer(channels[2], channels[3], 2, DEPTHS[shape.name][2], shape)
        self.layer4 = _layer(channels[3], channels[4], 2, DEPTHS[shape.name][3], shape)

    def forward(self, image: Tensor) -> list[Tensor]:
        c2 = self.layer1(self.maxpool(self.relu(self.bn1(self.conv1(image)))))
        c3 = self.layer2(c2)
        c4 = self.layer3(c3)
        return [c2, c3, c4, self.layer4(c4)]


def _layer(channels: int, out: int, stride: int, blocks: int, shape: ResNetShape) -> nn.Sequential:
    block = Bottleneck if shape.name in WITH_BOTTLENECKS else BasicBlock
    return nn.Sequential(block(channels, out, stride, shape), *(block(out, out, 1, shape) for _ in range(blocks - 1)))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    def __init__(self, channels: int, out: int, stride: int, shape: ResNetShape) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(out, shape.norm_eps)
        self.conv2 = nn.Conv2d(out, out, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(out, shape.norm_eps)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(channels, out, stride, shape)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        y += shortcut
        return functional.relu(y, inplace=True)


class Bottleneck(nn.Module):
    """A 3x3 convolution between two 1x1 ones, on a quarter of the channels, beside a shortcut."""

    def __init__(self, channels: int, out: int, stride: int, shape: ResNetShape) -> None:
        super().__init__()
        inside = out // EXPANSION
        strides = (stride, 1) if shape.stride_in_1x1 else (1, stride)
        self.conv1 = nn.Conv2d(channels, inside, 1, strides[0], bias=False)
        self.bn1 = nn.BatchNorm2d(inside, shape.norm_eps)
        self.conv2 = nn.Conv2d(inside, inside, 3, strides[1], 1, bias=False)
        self.bn2 = nn.BatchNorm2d(inside, shape.norm_eps)
        self.conv3 = nn.Conv2d(inside, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out, shape.norm_eps)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(channels, out, stride, shape)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        y += shortcut
        return functional.relu(y, inplace=True)


def _shortcut(channels: int, out: int, stride: int, shape: ResNetShape) -> nn.Module | None:
    if stride == 1 and channels == out:
        return None
    return nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out, shape.norm_eps))
