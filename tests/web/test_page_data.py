"""The bytes of a page: layout and precision."""

import gzip

import numpy as np
import pytest
import torch

from pansplat.export.page_data import PackedGaussians, count_bytes, pack_gaussians
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.pose import rotations_from_quats

ORIGIN = np.array((100.0, -1.0, 0.0))
ORDER = (1, 2, 0)


def read_planes(packed: PackedGaussians) -> np.ndarray:
    """(plane, Gaussian) bytes."""
    order = np.argsort([view.start for view in packed.views], kind="stable").tolist()
    blocks = [np.frombuffer(gzip.decompress(packed.contents[view]), np.uint8) for view in order]
    num_planes = sum(map(len, blocks)) // sum(view.count for view in packed.views)
    assert [len(block) for block in blocks] == [num_planes * packed.views[view].count for view in order]
    return np.concatenate([block.reshape(num_planes, -1) for block in blocks], 1)


def join(planes: np.ndarray) -> np.ndarray:
    """Upper bytes of float32 numbers to numbers."""
    words = np.zeros((4, planes.shape[1]), np.uint8)
    words[: len(planes)] = planes
    return np.ascontiguousarray(words.T).view(">f4")[:, 0].astype(np.float64)


def read_quats(planes: np.ndarray) -> np.ndarray:
    words = np.ascontiguousarray(planes.T).view(">u4")[:, 0]
    quats = np.zeros((len(words), 4))
    for row, word in zip(quats, words.tolist(), strict=True):
        others = [k for k in range(4) if k != word >> 30]
        row[others] = [((word >> shift & 1023) / 511 - 1) / 2**0.5 for shift in (20, 10, 0)]
        row[word >> 30] = np.sqrt(1 - (row**2).sum())
    return quats


@pytest.fixture(scope="module")
def packed(scene: Scene) -> PackedGaussians:
    return pack_gaussians(scene.gaussians, ORIGIN, ORDER, 1)


@pytest.fixture(scope="module")
def order(scene: Scene, packed: PackedGaussians) -> np.ndarray:
    """Index in the scene of each packed Gaussian, by the nearest mean."""
    planes = read_planes(packed)
    means = np.stack([join(planes[3 * axis : 3 * axis + 3]) for axis in range(3)], 1)
    found = torch.cdist(torch.from_numpy(means), scene.gaussians.means.double() - torch.from_numpy(ORIGIN)).argmin(1)
    assert len(set(found.tolist())) == len(scene.gaussians)
    return found.numpy()


def test_means_and_scales_are_rounded_to_the_stated_digits(scene, packed, order) -> None:
    planes = read_planes(packed)
    means = scene.gaussians.means.double().numpy()[order] - ORIGIN
    scales = scene.gaussians.scales.double().numpy()[order]
    for axis in range(3):
        error = np.abs(join(planes[3 * axis : 3 * axis + 3]) - means[:, axis])
        assert (error <= 2.0**-16 * np.abs(means[:, axis]) + 1e-5).all()
        error = np.abs(join(planes[9 + 2 * axis : 11 + 2 * axis]) - scales[:, axis])
        assert (error <= 2.0**-8 * scales[:, axis]).all()


def test_rotations_are_rounded_by_less_than_a_fifth_of_a_degree(scene, packed, order) -> None:
    read = rotations_from_quats(torch.from_numpy(read_quats(read_planes(packed)[15:19])))
    needed = rotations_from_quats(scene.gaussians.quats.double()[order])
    cosines = ((read * needed).sum((1, 2)) - 1) / 2
    assert float(cosines.clamp(-1, 1).acos().rad2deg().max()) < 0.2


def test_colours_opacities_and_harmonics_are_within_half_a_step(scene, packed, order) -> None:
    planes = read_planes(packed).astype(np.float64)
    harmonics = scene.gaussians.harmonics.double().numpy()[order]
    low, high = packed.color_range
    colors = (0.5 + 0.28209479 * harmonics[:, 0]).clip(low, high)
    assert np.abs(low + planes[20:23].T / 255 * (high - low) - colors).max() <= 0.51 * (high - low) / 255
    assert np.abs(planes[19] / 255 - scene.gaussians.opacities.numpy()[order]).max() <= 0.51 / 255
    read = read_planes(packed)[23:].view(np.int8).T.reshape(-1, 3, 3) / 127 * packed.harmonics_scale
    needed = harmonics[:, 1:].clip(-packed.harmonics_scale, packed.harmonics_scale)
    assert np.abs(read - needed).max() <= 0.51 / 127 * packed.harmonics_scale


def test_views_follow_each_other_in_the_given_order(scene: Scene, packed: PackedGaussians, order: np.ndarray) -> None:
    views = scene.gaussians.views.numpy()[order]
    assert read_planes(packed).size == count_bytes(len(scene.gaussians), 1)
    assert [view.start for view in packed.views] == [1400, 0, 700]
    assert (views == np.repeat(ORDER, 700)).all()


def test_extreme_numbers_are_packed(scene: Scene) -> None:
    few = scene.gaussians.select(torch.arange(4))
    extreme = Gaussians(
        means=torch.tensor([[0.0, 0, 0], [1e30, -1e30, 1e-30], [1, 1, 1], [1, 1, 1]]),
        scales=torch.tensor([[0.0, 0, 0], [1e30, 1e-30, 1], [1, 1, 1], [1, 1, 1]]),
        quats=torch.tensor([[0.0, 0, 0, 0], [-1e30, 0, 0, 0], [1e-30, 0, 0, 0], [0, 0, 0, -2]]),
        opacities=torch.tensor([0.0, 1, 1, 1]),
        harmonics=few.harmonics * 1e6,
        levels=few.levels,
        views=few.views,
    )
    planes = read_planes(pack_gaussians(extreme, np.zeros(3), (0,), 1))
    quats = read_quats(planes[15:19])
    for k in range(3):
        assert np.isfinite(join(planes[3 * k : 3 * k + 3])).all()
        assert np.isfinite(join(planes[9 + 2 * k : 11 + 2 * k])).all()
    assert np.isfinite(quats).all() and np.allclose(np.linalg.norm(quats, axis=1), 1)
