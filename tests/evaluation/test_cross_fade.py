"""The baseline: exact where it should be, and its reference figures."""

from pathlib import Path

import pytest
import torch

from pansplat.data.pairs import load_pairs
from pansplat.evaluation.cross_fade import cross_fade
from pansplat.evaluation.metrics import ws_psnr
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats


def pose_at(x: float, quat: tuple[float, ...] = (1, 0, 0, 0)) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor(quat, dtype=torch.float64))
    pose[0, 3] = x
    return pose


def sky(pose: torch.Tensor, height: int = 64) -> torch.Tensor:
    """What a camera sees of smooth colours at infinity."""
    directions = pixel_directions(height, 2 * height, dtype=torch.float64) @ pose[:3, :3].T
    return (0.5 + 0.4 * torch.sin(2 * directions + directions.roll(1, -1))).permute(2, 0, 1).float()


def test_a_far_away_world_is_reproduced_in_any_orientation() -> None:
    poses = [pose_at(0, (0.9, 0.2, 0.4, -0.1)), pose_at(1, (0.3, -0.8, 0.1, 0.5))]
    target = pose_at(0.3, (0.7, 0.1, -0.6, 0.3))
    faded = cross_fade(torch.stack([sky(p) for p in poses]), torch.stack(poses), target)
    assert float((faded - sky(target)).abs().max()) < 5e-3  # bilinear sampling


def test_at_an_input_the_other_does_not_matter() -> None:
    images = torch.stack((sky(pose_at(0)), torch.rand(3, 64, 128)))
    faded = cross_fade(images, torch.stack((pose_at(0), pose_at(1))), pose_at(0))
    torch.testing.assert_close(faded, images[0], atol=1e-5, rtol=0)


def test_weights_follow_the_distance() -> None:
    images = torch.stack((torch.zeros(3, 8, 16), torch.ones(3, 8, 16)))
    faded = cross_fade(images, torch.stack((pose_at(0), pose_at(1))), pose_at(0.25))
    torch.testing.assert_close(faded, torch.full((3, 8, 16), 0.25))


@pytest.mark.shared
@pytest.mark.parametrize(("folder", "expected"), [("mp3d_sample", [16.0]), ("zind", [14.1, 15.8, 17.1])])
def test_reference_figures_of_real_rooms(shared: Path, folder: str, expected: list[float]) -> None:
    pairs = [pair for pair in load_pairs(shared / "data" / folder) if pair.targets]
    scores = []
    for pair in pairs:
        context, target = pair.load_context(512), pair.load_targets(512)
        faded = cross_fade(context.images, context.cam2world, target.cam2world[0])
        scores.append(ws_psnr(faded, target.images[0]))
    assert sorted(scores) == pytest.approx(expected, abs=0.1)
