"""Posed panoramas as tensors: views, samples of context and target views, and batches of samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.world import USER_FRAME, WorldFrame
from pansplat.system.descriptions import describe_count, describe_range, list_first
from pansplat.system.options import CAMERA_HEIGHT

ONE_POSITION = 1e-3  # distance between cameras, relative to near, up to which they have no parallax


@dataclass(frozen=True, eq=False)
class Views:
    """Panoramas of one place with their poses, all of one size.

    Attributes:
        images: RGB in [0, 1], float32.
        cam2world: float64, OpenCV axes, metres.
        masks: True where a pixel shows the scene; False for what is fixed to the camera (tripod, caps, operator).
        near, far: radial depth range to search, metres.
        names: one per view, for messages and file names.
        depths: radial distance in metres, 0 where unknown; None when the data set has no depth.
        camera_height: over the floor, metres; the scale of a single view.
        frame: where the world of the poses is in the user's world, that of files.
        holes: True for pixels that show nothing: holes of scans, and black caps around the poles; None without any.
    """

    images: Float[Tensor, "view 3 height width"]
    cam2world: Float[Tensor, "view 4 4"]
    masks: Bool[Tensor, "view height width"]
    near: float
    far: float
    names: tuple[str, ...]
    depths: Float[Tensor, "view height width"] | None = None
    camera_height: float = CAMERA_HEIGHT
    frame: WorldFrame = USER_FRAME
    holes: Bool[Tensor, "view height width"] | None = None

    @property
    def shown(self) -> Bool[Tensor, "view height width"]:
        """True where a pixel shows the scene, outside of masks and holes."""
        return self.masks if self.holes is None else self.masks & ~self.holes

    def __repr__(self) -> str:
        count, _, height, width = self.images.shape
        parts = [
            describe_count(count, "panorama") + (f" ({list_first(self.names)})" if count else ""),
            f"{height}x{width}",
            f"near and far {describe_range(self.near, self.far, 'm')}",
        ]
        if count:
            parts.append(f"masks show {100 * float(torch.as_tensor(self.masks).float().mean()):.3g} %")
        if self.depths is not None:
            parts.append("with depths")
        return f"<Views: {', '.join(parts)}>"


def select_views(views: Views, indices: Sequence[int]) -> Views:
    """The views at `indices`, in that order."""
    chosen = torch.tensor(list(indices), dtype=torch.long)
    return replace(
        views,
        images=views.images[chosen],
        cam2world=views.cam2world[chosen],
        masks=views.masks[chosen],
        names=tuple(views.names[i] for i in indices),
        depths=None if views.depths is None else views.depths[chosen],
        holes=None if views.holes is None else views.holes[chosen],
    )


@dataclass(frozen=True, eq=False)
class Sample:
    """One scene: `context` is the input of a predictor, `targets` are compared with renderings of its prediction."""

    name: str
    context: Views
    targets: Views


@dataclass(frozen=True, eq=False)
class Batch:
    """Stacked samples with equal numbers and sizes of views.

    Attributes:
        names: one per sample.
        images, target_images: RGB in [0, 1], float32.
        cam2world, target_cam2world: float64, OpenCV axes, metres.
        masks, target_masks: True where a pixel shows the scene.
        depths: radial distance in metres, 0 where unknown; None when no sample has depth.
        near, far: radial depth range to search, metres, one value per view.
    """

    names: tuple[str, ...]
    images: Float[Tensor, "batch view 3 height width"]
    cam2world: Float[Tensor, "batch view 4 4"]
    masks: Bool[Tensor, "batch view height width"]
    depths: Float[Tensor, "batch view height width"] | None
    target_images: Float[Tensor, "batch target 3 height width"]
    target_cam2world: Float[Tensor, "batch target 4 4"]
    target_masks: Bool[Tensor, "batch target height width"]
    near: Float[Tensor, "batch view"]
    far: Float[Tensor, "batch view"]

    def __len__(self) -> int:
        return len(self.names)

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Batch:
        """The batch on another device; `dtype` is that of its floating-point tensors, by default unchanged."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        types = {name: dtype if value.is_floating_point() else None for name, value in tensors.items()}
        return replace(self, **{name: v.to(device, types[name], non_blocking=True) for name, v in tensors.items()})


def collate(samples: Sequence[Sample]) -> Batch:
    """Stack samples into a batch."""
    if not samples:
        raise InputError("needed at least one sample for a batch, got none.")
    first = samples[0]
    for sample in samples[1:]:
        for part in ("context", "targets"):
            expected, got = (tuple(getattr(s, part).images.shape) for s in (first, sample))
            if expected != got:
                raise InputError(
                    f"cannot batch {sample.name} with {first.name}: needed {part} of shape {expected} (view 3 height "
                    f"width), got {got}; use the same number of targets in all samples, or a batch size of 1."
                )
    contexts, targets = [s.context for s in samples], [s.targets for s in samples]
    views = len(first.context.images)
    return Batch(
        names=tuple(sample.name for sample in samples),
        images=torch.stack([v.images for v in contexts]),
        cam2world=torch.stack([v.cam2world for v in contexts]),
        masks=torch.stack([v.masks for v in contexts]),
        depths=_stack_depths(contexts),
        target_images=torch.stack([v.images for v in targets]),
        target_cam2world=torch.stack([v.cam2world for v in targets]),
        target_masks=torch.stack([v.masks for v in targets]),
        near=torch.tensor([[v.near] * views for v in contexts], dtype=torch.float32),
        far=torch.tensor([[v.far] * views for v in contexts], dtype=torch.float32),
    )


def _stack_depths(views: Sequence[Views]) -> Float[Tensor, "batch view height width"] | None:
    """Stacked depths, 0 (unknown) for samples without depth; None when no sample has depth."""
    if all(v.depths is None for v in views):
        return None
    return torch.stack([torch.zeros(v.masks.shape) if v.depths is None else v.depths for v in views])
