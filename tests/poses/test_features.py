"""Features of mirrored panoramas, and matches."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray as Array

from pansplat.poses.features import _PRIORS, _RATIOS, Features, detect_features, match_features
from pansplat.poses.solvers import angle_between

SAMPLE = Path(__file__).resolve().parents[2] / "assets" / "living_room"


@pytest.fixture(scope="module")
def picture() -> Array:
    """The sample at a small size."""
    image = cv2.imread(str(SAMPLE / "left.jpg"), cv2.IMREAD_GRAYSCALE)
    return cv2.resize(image, (512, 256), interpolation=cv2.INTER_AREA)


def test_features_turn_with_the_panorama(picture: Array) -> None:
    first = detect_features(picture)
    second = detect_features(np.roll(picture, 128, axis=1))  # by 90 degrees
    matches = match_features(first, second)
    good = matches.indices[matches.prior > 0.67]
    a, b = first.bearings[good[:, 0]], second.bearings[good[:, 1]]
    turned = np.stack((a[:, 2], a[:, 1], -a[:, 0]), axis=1)
    assert len(good) > 100 and np.median(angle_between(turned, b)) < 1e-3  # the faces at the poles are sampled anew


def test_features_of_a_mirror_image_match_when_they_are_mirrored(picture: Array) -> None:
    first, flipped = detect_features(picture), detect_features(np.ascontiguousarray(picture[:, ::-1]))
    counts = [(match_features(first, second).prior > 0.67).sum() for second in (flipped, flipped.mirrored())]
    assert counts[1] > 500 > 10 * counts[0]


def test_matches_of_equal_places_count_once() -> None:
    rng = np.random.default_rng(0)
    bearings = rng.normal(size=(20, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    descriptors = rng.uniform(size=(40, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    twice = Features(np.tile(bearings, (2, 1)), descriptors, np.ones(40), np.full(40, 0.01))
    matches = match_features(twice, twice)
    assert len(matches) == 20 and (np.diff(matches.prior) <= 0).all()


def test_any_number_of_features_is_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.poses.features._CHUNK", 8)
    rng = np.random.default_rng(0)
    for count in range(2, 19):  # of which 9 and 17 leave one row to the last chunk
        bearings, descriptors = rng.normal(size=(count, 3)), rng.uniform(size=(count, 128)).astype(np.float32)
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        features = Features(bearings, descriptors, np.ones(count), np.full(count, 0.01))
        assert sorted(map(tuple, match_features(features, features).indices)) == [(k, k) for k in range(count)]


def test_matches_are_mutually_nearest_with_the_prior_of_their_ratio(picture: Array) -> None:
    first, second = detect_features(picture), detect_features(np.roll(picture, 40, axis=1))
    found = match_features(first, second)
    similarity = first.descriptors.astype(np.float64) @ second.descriptors.T
    i, j = found.indices.T
    assert np.array_equal(similarity[i].argmax(axis=1), j) and np.array_equal(similarity[:, j].argmax(axis=0), i)
    row, column = (np.sqrt(1 - np.partition(s, -2, axis=1)[:, -2]) for s in (similarity[i], similarity.T[j]))
    ratio = np.sqrt(np.maximum(1 - similarity[i, j], 0)) * (1 / row + 1 / column) / 2
    assert found.prior == pytest.approx(np.interp(ratio, _RATIOS, _PRIORS), abs=2e-3)
