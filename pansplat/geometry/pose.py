"""Rigid poses, rotations, and the weights of views by distance.

Quaternions are wxyz; poses are cam2world, 4x4, OpenCV axes, metres.
"""

import torch
from jaxtyping import Float
from torch import Tensor

AHEAD_EXPONENT = 0.55  # exponent of the weight of a view straight ahead (docs/rendering.md, section 7)


def rotations_from_quats(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (wxyz) of any length; the zero quaternion is the identity."""
    norm = quats.norm(dim=-1, keepdim=True)
    identity = torch.tensor((1.0, 0.0, 0.0, 0.0), dtype=quats.dtype, device=quats.device)
    safe = torch.where(norm > 0, norm, torch.ones_like(norm))
    w, x, y, z = torch.where(norm > 0, quats / safe, identity).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quats_from_rotations(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (wxyz, w >= 0) of rotation matrices, computed from the largest component."""
    m = rotations
    t = torch.stack(
        (
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ),
        dim=-1,
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    t0, t1, t2, t3 = t.unbind(-1)
    rows = (
        t0, a, b, c,
        a, t1, d, e,
        b, d, t2, f,
        c, e, f, t3,
    )  # fmt: skip
    candidates = torch.stack(rows, dim=-1).unflatten(-1, (4, 4))
    best = t.argmax(dim=-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    quats = torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def invert_pose(pose: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of rigid transforms; it is exactly rigid."""
    rotation = pose[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(pose)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ pose[..., :3, 3:]).squeeze(-1)
    inverse[..., 3, 3] = 1
    return inverse


def orthonormal_error(pose: Float[Tensor, "4 4"]) -> float:
    """Largest error of R R' = 1 and of the bottom row: 0 for a rigid pose, inf for a mirrored one."""
    rotation = pose[:3, :3].double()
    if not torch.isfinite(pose).all() or torch.linalg.det(rotation) <= 0:
        return float("inf")
    identity = torch.eye(4, dtype=torch.float64, device=pose.device)
    gram = (rotation @ rotation.T - identity[:3, :3]).abs().max()
    bottom = (pose[3].double() - identity[3]).abs().max()
    return float(torch.maximum(gram, bottom))


def interpolate_poses(start: Float[Tensor, "4 4"], end: Float[Tensor, "4 4"], fraction: float) -> Float[Tensor, "4 4"]:
    """The pose at a fraction between two poses: linear in position, spherical linear (slerp) in rotation."""
    a, b = quats_from_rotations(torch.stack((start[:3, :3], end[:3, :3])).double())
    b = torch.where((a * b).sum() < 0, -b, b)
    angle = torch.acos((a * b).sum().clamp(-1, 1))
    if float(angle) < 1e-6:
        quat = (1 - fraction) * a + fraction * b
    else:
        quat = (torch.sin((1 - fraction) * angle) * a + torch.sin(fraction * angle) * b) / torch.sin(angle)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(quat)
    pose[:3, 3] = (1 - fraction) * start[:3, 3].double() + fraction * end[:3, 3].double()
    return pose.to(start)


def nearest_views(cam2world: Float[Tensor, "view 4 4"], view: int, count: int) -> list[int]:
    """At most `count` other views, by the distance of their cameras from a view's."""
    distances = (cam2world[:, :3, 3] - cam2world[view, :3, 3]).norm(dim=1)
    order = distances.argsort(stable=True).tolist()
    return [other for other in order if other != view][:count]


def blend_weights(
    position: Float[Tensor, "3"], positions: Float[Tensor, "view 3"], forward: Float[Tensor, "3"] | None = None
) -> Float[Tensor, "view"]:
    """Weights of the input views at a camera position: normalised inverse distances.

    The weights are non-negative and sum to one. At an input position they are one-hot; inputs that coincide with the
    position have equal weights.

    Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.

    Args:
        position: the camera's.
        positions: those of the input views.
        forward: unit direction of a perspective picture. An input view ahead weighs more, one behind less: it has seen
            from nearer what is ahead.
    """
    if positions.shape[0] < 1:
        raise ValueError("`positions` must hold at least one view, got none")
    distances = torch.linalg.vector_norm(position - positions, dim=1)
    nearest = distances.detach().amin()
    is_at_position = distances == 0
    # Only ratios matter. In units of the nearest distance nothing overflows.
    divisors = torch.where(is_at_position, torch.ones_like(distances), distances)
    closeness = torch.where(is_at_position, torch.ones_like(distances), nearest / divisors)
    if forward is not None:
        closeness = closeness * torch.exp(AHEAD_EXPONENT * ((positions - position) @ forward.to(distances) / divisors))
    return closeness / closeness.sum()
