"""EfficientNet-Lite0 as an encoder of panoramas: features at 1/2 to 1/32; its convolutions continue over the seam.

Source: Tan and Le, https://arxiv.org/abs/1905.11946; the Lite variant has no squeeze-and-excitation and uses ReLU6.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu6

from pansplat.model.layers import PanoramaConv2d, convolve_and_normalize

_EPSILON, _MOMENTUM = 1e-3, 0.01  # settings of batch normalisation
_STEM_CHANNELS = 32


class Stage(NamedTuple):
    """Blocks of equal width."""

    kernel: int
    stride: int
    expansion: int
    channels: int
    blocks: int


STAGES = (
    Stage(3, 1, 1, 16, 1),
    Stage(3, 2, 6, 24, 2),
    Stage(5, 2, 6, 40, 2),
    Stage(3, 2, 6, 80, 3),
    Stage(5, 1, 6, 112, 3),
    Stage(5, 2, 6, 192, 4),
    Stage(3, 1, 6, 320, 1),
)
_OUTPUTS = (0, 1, 2, 4, 6)  # the last stage of each scale; its maps are an output
CHANNELS = tuple(STAGES[n].channels for n in _OUTPUTS)  # at 1/2, 1/4, 1/8, 1/16 and 1/32 size


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution and projection, with a shortcut between maps of equal shape.

    Source: Sandler et al., https://arxiv.org/abs/1801.04381.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = inputs * expansion
        self.has_shortcut = stride == 1 and inputs == outputs
        self.expand = self.expand_norm = None
        if expansion > 1:
            self.expand = PanoramaConv2d(inputs, inner, 1, border="sphere", bias=False)
            self.expand_norm = _make_norm(inner)
        self.depthwise = PanoramaConv2d(inner, inner, kernel, border="sphere", stride=stride, groups=inner, bias=False)
        self.depthwise_norm = _make_norm(inner)
        self.project = PanoramaConv2d(inner, outputs, 1, border="sphere", bias=False)
        self.project_norm = _make_norm(outputs)

    def forward(self, x: Float[Tensor, "batch c height width"]) -> Float[Tensor, "batch d h w"]:
        inner = x
        if self.expand is not None and self.expand_norm is not None:
            inner = relu6(convolve_and_normalize(self.expand, self.expand_norm, inner))
        inner = relu6(convolve_and_normalize(self.depthwise, self.depthwise_norm, inner))
        inner = convolve_and_normalize(self.project, self.project_norm, inner)
        return x + inner if self.has_shortcut else inner


class EfficientNetLite0(nn.Module):
    """Features (`CHANNELS`) of panoramas at 1/2, 1/4, 1/8, 1/16 and 1/32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = PanoramaConv2d(3, _STEM_CHANNELS, 3, border="sphere", stride=2, bias=False)
        self.stem_norm = _make_norm(_STEM_CHANNELS)
        self.blocks = nn.ModuleList()
        self._last_of_stage: list[int] = []
        width = _STEM_CHANNELS
        for stage in STAGES:
            for n in range(stage.blocks):
                stride = stage.stride if n == 0 else 1
                self.blocks.append(InvertedResidual(width, stage.channels, stage.kernel, stride, stage.expansion))
                width = stage.channels
            self._last_of_stage.append(len(self.blocks) - 1)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> list[Tensor]:
        """Encode RGB in [0, 1]; 32 divides height and width."""
        x = relu6(convolve_and_normalize(self.stem, self.stem_norm, (images - 127 / 255) * (255 / 128)))
        outputs = [self._last_of_stage[n] for n in _OUTPUTS]
        features = []
        for n, block in enumerate(self.blocks):
            x = block(x)
            if n in outputs:
                features.append(x)
        return features


def _make_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_EPSILON, momentum=_MOMENTUM)
