"""UniFuse: monocular depth features of panoramas for the cost volume. Frozen, always in eval mode.

One ResNet-18 encodes the panorama, another one its six cube faces. At five scales the features of the faces are
projected onto the panorama and fused; a decoder upsamples the fused features to 256x512 for any input size.

`compat="official"` pads rows with zeros, resizes without wrapping, and encodes each face once. `compat="fixed"` wraps
columns and continues over the poles in the panorama's encoder and decoder and in the resizing. It also encodes the
faces up and down in two orientations and averages them, so that half a turn of the panorama rolls the features.
Both modes keep two properties of the training: faces have zero padding, and whole rows of the panorama belong to the
faces up and down.

Source: Jiang et al., UniFuse, https://arxiv.org/abs/2102.03550; docs/official.md, sections 2.3 and 5.
"""

from __future__ import annotations

import functools

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import elu, interpolate, max_pool2d, relu

from pansplat.geometry.cubemap import equirect_from_strip, strip_from_equirect, strip_lookup
from pansplat.geometry.equirect import Border, pad_equirect
from pansplat.model.feature_pyramid import normalize
from pansplat.model.layers import (
    Compat,
    Images,
    PanoramaConv2d,
    TwoConvs,
    choose_border,
    convolve_and_normalize,
    resize,
    to_channels_last,
)

HEIGHT, FACE_SIZE = 512, 256  # rows of the encoders' panorama, and pixels along their faces
SCALES = (5, 4, 3, 2, 1)  # from coarse to fine: 1/32 to 1/2 of the panorama's size
FEATURE_CHANNELS = 32
_ENCODED = {5: 512, 4: 256, 3: 128, 2: 64, 1: 64}  # channels of each encoder
_DECODED = {5: 256, 4: 128, 3: 64, 2: 32}  # channels after the upsampling from a scale


class MonocularDepth(nn.Module):
    """UniFuse: features at 1/2 scale, and depth."""

    def __init__(self, compat: Compat = "official") -> None:
        super().__init__()
        self.compat: Compat = compat
        self.panorama_encoder = ResNet18(choose_border(compat))
        self.face_encoder = ResNet18("zeros")
        self.decoder = Decoder(choose_border(compat))
        self.register_buffer("max_depth", torch.tensor(10.0))
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> MonocularDepth:
        """Stay in eval mode: the network is frozen."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, images: Images) -> Float[Tensor, "batch view 32 256 512"]:
        """Features of panoramas of any size, RGB in [0, 1]."""
        panoramas, strips = self.prepare_inputs(images.flatten(0, 1))
        from_panorama = self.panorama_encoder(to_channels_last(normalize(panoramas)))
        from_faces = self._encode_faces(strips.unflatten(-1, (6, FACE_SIZE)).permute(0, 3, 1, 2, 4))
        projected = {scale: to_channels_last(_project_faces(from_faces[scale], scale)) for scale in SCALES}
        return self.decoder(from_panorama, projected).unflatten(0, images.shape[:2])

    @torch.no_grad()
    def depth(self, features: Float[Tensor, "batch view 32 256 512"]) -> Float[Tensor, "batch view 512 1024"]:
        """Radial depth in metres of the features of `forward`; PanSplat does not use it."""
        logits = self.decoder.head(features.flatten(0, 1))
        return (self.max_depth * logits.sigmoid()).squeeze(1).unflatten(0, features.shape[:2])

    def prepare_inputs(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Float[Tensor, "batch 3 512 1024"], Float[Tensor, "batch 3 256 1536"]]:
        """Make the inputs of both encoders: panoramas resized via 256x512 as in training, and strips of six faces."""
        half = resize(images, (HEIGHT // 2, HEIGHT), self.compat)
        panoramas = resize(half, (HEIGHT, 2 * HEIGHT), self.compat)
        strips = torch.stack([strip_from_equirect(panorama, FACE_SIZE) for panorama in panoramas])
        return panoramas, strips

    def _encode_faces(self, faces: Float[Tensor, "batch 6 3 n n"]) -> dict[int, Float[Tensor, "batch 6 channel m m"]]:
        """Features of the faces at each scale; "fixed" averages two orientations of the faces up and down."""
        if self.compat == "fixed":
            faces = torch.cat((faces, _rotate_half_turn(faces[:, 4:])), dim=1)
        encoded = self.face_encoder(to_channels_last(normalize(faces.flatten(0, 1))))
        by_face = {scale: maps.unflatten(0, faces.shape[:2]) for scale, maps in encoded.items()}
        if self.compat == "official":
            return by_face
        return {
            scale: torch.cat((maps[:, :4], (maps[:, 4:6] + _rotate_half_turn(maps[:, 6:])) / 2), dim=1)
            for scale, maps in by_face.items()
        }


class ResNet18(nn.Module):
    """Features of a ResNet-18 at 1/2, 1/4, ..., 1/32, by scale 1 to 5.

    Source: He et al., https://arxiv.org/abs/1512.03385.
    """

    def __init__(self, border: Border) -> None:
        super().__init__()
        self.border: Border = border
        self.stem = PanoramaConv2d(3, 64, 7, stride=2, bias=False, border=border)
        self.stem_norm = nn.BatchNorm2d(64)
        channels = (64, 64, 128, 256, 512)
        self.stages = nn.ModuleList(
            nn.Sequential(
                ResidualBlock(channels[i], channels[i + 1], stride=1 if i == 0 else 2, border=border),
                ResidualBlock(channels[i + 1], channels[i + 1], stride=1, border=border),
            )
            for i in range(4)
        )

    def forward(self, x: Float[Tensor, "batch 3 height width"]) -> dict[int, Tensor]:
        features = {1: relu(convolve_and_normalize(self.stem, self.stem_norm, x))}
        x = max_pool2d(pad_equirect(features[1], 1, self.border), 3, stride=2)
        for scale, stage in enumerate(self.stages, start=2):
            x = features[scale] = stage(x)
        return features


class ResidualBlock(TwoConvs):
    """relu(x + conv(relu(conv(x)))) with batch normalisation after each convolution."""

    def __init__(self, inputs: int, outputs: int, *, stride: int, border: Border) -> None:
        super().__init__(inputs, outputs, stride=stride, border=border)
        self.shortcut_conv = self.shortcut_norm = None
        if stride > 1:
            self.shortcut_conv = PanoramaConv2d(inputs, outputs, 1, stride=stride, bias=False, border=border)
            self.shortcut_norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Float[Tensor, "batch c height width"]) -> Float[Tensor, "batch d h w"]:
        inner = self.convolve(x)
        if self.shortcut_conv is not None and self.shortcut_norm is not None:
            x = convolve_and_normalize(self.shortcut_conv, self.shortcut_norm, x)
        return relu(x + inner)


class Fusion(TwoConvs):
    """Adds to the face features a residual computed from both inputs, and joins the sum with the panorama features.

    Source: UniFuse, section III-B ("CEE", without squeeze and excitation).
    """

    def __init__(self, channels: int, border: Border) -> None:
        super().__init__(2 * channels, channels, kernel=1, border=border)
        self.join = nn.Conv2d(2 * channels, channels, 1, bias=False)

    def forward(
        self, panorama: Float[Tensor, "batch c height width"], faces: Float[Tensor, "batch c height width"]
    ) -> Float[Tensor, "batch c height width"]:
        correction = self.convolve(torch.cat((panorama, faces), dim=1))
        return relu(self.join(torch.cat((panorama, faces + correction), dim=1)))


class Decoder(nn.Module):
    """Decodes fused features from 1/32 to 1/2; `head` continues to depth at full size."""

    def __init__(self, border: Border) -> None:
        super().__init__()
        self.fuse = nn.ModuleDict({str(s): Fusion(_ENCODED[s], border) for s in SCALES})
        self.up = nn.ModuleDict()
        self.merge = nn.ModuleDict()
        width = _ENCODED[5]
        for scale in SCALES[:-1]:
            self.up[str(scale)] = PanoramaConv2d(width, _DECODED[scale], 3, border=border)
            joined = _DECODED[scale] + _ENCODED[scale - 1]
            width = FEATURE_CHANNELS if scale == 2 else _ENCODED[scale - 1]
            self.merge[str(scale - 1)] = PanoramaConv2d(joined, width, 3, border=border)
        self.head = nn.Sequential(
            PanoramaConv2d(FEATURE_CHANNELS, 16, 3, border=border),
            nn.ELU(),
            nn.Upsample(scale_factor=2),
            PanoramaConv2d(16, 16, 3, border=border),
            nn.ELU(),
            PanoramaConv2d(16, 1, 3, border=border),
        )

    def forward(self, from_panorama: dict[int, Tensor], from_faces: dict[int, Tensor]) -> Float[Tensor, "batch 32 h w"]:
        x = self.fuse["5"](from_panorama[5], from_faces[5])
        for scale in SCALES[:-1]:
            fine = scale - 1
            x = interpolate(elu(self.up[str(scale)](x)), scale_factor=2)
            fused = self.fuse[str(fine)](from_panorama[fine], from_faces[fine])
            x = elu(self.merge[str(fine)](torch.cat((x, fused), dim=1)))
        return x


def _project_faces(
    faces: Float[Tensor, "batch 6 channel n n"], scale: int
) -> Float[Tensor, "batch channel height width"]:
    """Resample the features of six faces on the panorama."""
    return equirect_from_strip(faces.permute(0, 2, 3, 1, 4).flatten(-2), _strip_lookup(scale))


@functools.cache
def _strip_lookup(scale: int) -> Float[Tensor, "height width 3"]:
    """Positions of the panorama's pixels on the six faces; computed, although official checkpoints store them."""
    return strip_lookup(HEIGHT >> scale)


def _rotate_half_turn(faces: Float[Tensor, "batch face channel n n"]) -> Float[Tensor, "batch face channel n n"]:
    """Rotate faces by half a turn in their plane; half a turn of the panorama does this to the faces up and down."""
    return faces.flip(-1, -2)
