"""The six faces of a cubemap in the panorama camera's frame.

Source: PanSplat, section 3.4; face order and axes as in the original renderer (OFFICIAL.md 10.1).
"""

import torch
from jaxtyping import Float
from torch import Tensor

FACES = ("front", "right", "back", "left", "up", "down")

# Columns of each matrix are the face's right, down and forward in the panorama camera's axes.
_RIGHT_DOWN_FORWARD = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
)


def face_rotations(*, dtype: torch.dtype = torch.float64) -> Float[Tensor, "face 3 3"]:
    """Rotation from each face's camera axes to the panorama's (columns: right, down, forward)."""
    return torch.tensor(_RIGHT_DOWN_FORWARD, dtype=dtype).transpose(-1, -2).contiguous()


def face_poses(cam2world: Float[Tensor, "4 4"]) -> Float[Tensor, "face 4 4"]:
    """Camera-to-world poses of the six 90-degree pinhole faces of a panorama camera."""
    poses = cam2world.expand(6, 4, 4).clone()
    poses[:, :3, :3] = cam2world[:3, :3] @ face_rotations(dtype=cam2world.dtype).to(cam2world.device)
    return poses
