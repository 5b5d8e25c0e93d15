"""LightGlue: matches between the keypoints of two images, by attention within and between them.

Nine layers of self- and cross-attention exchange what the keypoints of both images look like and where they are. Two
keypoints match if each is the other's most similar one and both are likely to have a partner. After each layer a
confidence stops the network early, and keypoints that certainly have no partner are dropped.

Source: P. Lindenberger, P.-E. Sarlin, M. Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

_LAYERS, _HEADS, _WIDTH = 9, 4, 256
_HEAD_WIDTH = _WIDTH // _HEADS
_STOP_SHARE = 0.95  # the network stops when so many of the keypoints are confident
_MIN_MATCHABLE = 0.01  # a confident keypoint with a lower probability to have a partner is dropped

Keypoints = Float[Tensor, "_ 256"]
"""States of the keypoints of one image."""
Turn = tuple[Float[Tensor, "_ 32"], Float[Tensor, "_ 32"]]
"""Cosines and sines that encode the positions of keypoints."""


class _Update(nn.Module):
    """The states plus a function of them and of the message that attention gave."""

    def __init__(self) -> None:
        super().__init__()
        self.message = nn.Linear(_WIDTH, _WIDTH)
        self.inner = nn.Linear(2 * _WIDTH, 2 * _WIDTH)
        self.norm = nn.LayerNorm(2 * _WIDTH)
        self.outer = nn.Linear(2 * _WIDTH, _WIDTH)

    def forward(self, states: Keypoints, context: Float[Tensor, "head keypoint 64"]) -> Keypoints:
        message = self.message(context.transpose(0, 1).flatten(1))
        hidden = self.norm(self.inner(torch.cat((states, message), dim=1)))
        return states + self.outer(functional.gelu(hidden))


class _Layer(nn.Module):
    """Self-attention of each image, whose similarities depend on relative positions, then attention between both."""

    def __init__(self) -> None:
        super().__init__()
        self.self_in = nn.Linear(_WIDTH, 3 * _WIDTH)
        self.self_update = _Update()
        self.cross_in = nn.Linear(_WIDTH, 2 * _WIDTH)
        self.cross_update = _Update()

    def forward(self, first: Keypoints, second: Keypoints, turns: list[Turn]) -> tuple[Tensor, Tensor]:
        first, second = self._attend_within(first, turns[0]), self._attend_within(second, turns[1])
        (key_a, value_a), (key_b, value_b) = self._cross_parts(first), self._cross_parts(second)
        return (
            self.cross_update(first, _attend(key_a, key_b, value_b)),
            self.cross_update(second, _attend(key_b, key_a, value_a)),
        )

    def _attend_within(self, states: Keypoints, turn: Turn) -> Keypoints:
        query, key, value = self.self_in(states).unflatten(1, (3, _HEADS, -1)).permute(1, 2, 0, 3)
        return self.self_update(states, _attend(_rotate(query, turn), _rotate(key, turn), value))

    def _cross_parts(self, states: Keypoints) -> Float[Tensor, "2 head keypoint 64"]:
        """Keys, which are queries of the other direction, and values."""
        return self.cross_in(states).unflatten(1, (2, _HEADS, -1)).permute(1, 2, 0, 3)


def _attend(query: Tensor, key: Tensor, value: Tensor) -> Float[Tensor, "head keypoint 64"]:
    return functional.scaled_dot_product_attention(query[None], key[None], value[None])[0]


def _rotate(values: Float[Tensor, "head keypoint 64"], turn: Turn) -> Float[Tensor, "head keypoint 64"]:
    """The values, of which the first half are real and the second half imaginary parts, turned by their positions."""
    cosine, sine = turn
    real, imaginary = values.chunk(2, dim=2)
    return torch.cat((real * cosine - imaginary * sine, imaginary * cosine + real * sine), dim=2)


class LightGlue(nn.Module):
    """The network for descriptors of ALIKED, for one pair of images at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.entry = nn.Linear(128, _WIDTH)
        self.position = nn.Linear(2, _HEAD_WIDTH // 2, bias=False)
        self.layers = nn.ModuleList(_Layer() for _ in range(_LAYERS))
        self.confidence = nn.ModuleList(nn.Linear(_WIDTH, 1) for _ in range(_LAYERS - 1))
        self.matchable = nn.ModuleList(nn.Linear(_WIDTH, 1) for _ in range(_LAYERS))
        self.similar = nn.ModuleList(nn.Linear(_WIDTH, _WIDTH) for _ in range(_LAYERS))

    def forward(
        self,
        first: tuple[Float[Tensor, "m 2"], Float[Tensor, "m 128"]],
        second: tuple[Float[Tensor, "n 2"], Float[Tensor, "n 128"]],
        adaptive: bool = True,
    ) -> tuple[Int[Tensor, "match 2"], Float[Tensor, "match"]]:
        """Mutually best pairs of keypoints, and the probability of each.

        Args:
            first, second: positions and descriptors of the keypoints; the longer side of an image is -1 to 1.
            adaptive: stop early, and drop keypoints without a partner.
        """
        states = [self.entry(descriptors) for _, descriptors in (first, second)]
        turns = [(angle.cos(), angle.sin()) for angle in (self.position(points) for points, _ in (first, second))]
        index = [torch.arange(len(points), device=points.device) for points, _ in (first, second)]
        layer = 0
        for layer in range(_LAYERS):
            if min(map(len, states)) == 0:
                return torch.empty(0, 2, dtype=torch.long), torch.empty(0)
            states = list(self.layers[layer](*states, turns))
            if layer == _LAYERS - 1 or not adaptive:
                continue
            threshold = 0.8 + 0.1 * math.exp(-4 * layer / _LAYERS)
            sure = [torch.sigmoid(self.confidence[layer](s))[:, 0] >= threshold for s in states]
            # Dropped keypoints are sure.
            unsure = sum(int((~s).sum()) for s in sure)
            if unsure < (1 - _STOP_SHARE) * (len(first[0]) + len(second[0])):
                break
            for n in range(2):
                kept = ~sure[n] | (self._log_matchable(layer, states[n])[:, 0] > math.log(_MIN_MATCHABLE))
                states[n], index[n] = states[n][kept], index[n][kept]
                turns[n] = turns[n][0][kept], turns[n][1][kept]
        rows, columns, probability = self._assign(layer, *states)
        return torch.stack((index[0][rows], index[1][columns]), dim=1), probability

    def _assign(self, layer: int, first: Keypoints, second: Keypoints) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns of the mutually most probable pairs, and their probabilities."""
        a, b = self.similar[layer](first), self.similar[layer](second)
        similarity = a @ b.T / math.sqrt(_WIDTH)
        log = functional.log_softmax(similarity, 0) + functional.log_softmax(similarity, 1)
        log += self._log_matchable(layer, first) + self._log_matchable(layer, second).T
        best, column = log.max(dim=1)
        row = torch.arange(len(log), device=log.device)
        mutual = log.argmax(dim=0)[column] == row
        return row[mutual], column[mutual], best[mutual].exp()

    def _log_matchable(self, layer: int, states: Keypoints) -> Float[Tensor, "keypoint 1"]:
        """Logarithm of the probability to have a partner."""
        return functional.logsigmoid(self.matchable[layer](states))
