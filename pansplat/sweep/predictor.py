"""The default predictor and `sweep`, from posed panoramas to Gaussians: observe, search, lift, fit colours."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import fit_panoramas
from pansplat.geometry.world import require_working_world
from pansplat.inputs.panorama_sets import MAX_CONTEXT
from pansplat.predictor import require_matching_inputs, select_item
from pansplat.rendering.color_fit import fit_colors
from pansplat.sweep.lift import lift
from pansplat.sweep.search import SearchConfig, observe, search
from pansplat.sweep.surface import PosedImages
from pansplat.system.progress import report_progress, stage
from pansplat.system.source_hash import hash_sources

if TYPE_CHECKING:
    from pansplat.sweep.guided_sweep import NetworkPrior

_HEIGHT_MULTIPLE = 8  # the levels of the Gaussians divide the height; other heights are resized to the next multiple


class Sweep:
    """Hierarchical sphere sweep with a hand-crafted matching cost; see docs/sweep.md.

    It takes one or more views and matches each against a few others. A prior model estimates depth where the
    panoramas have no evidence: `default` has one (`guided_sweep`), `sweep` has none.
    """

    max_views = MAX_CONTEXT
    """Largest number of views of a prediction, whose time grows linearly: a view is matched against a few others."""
    default_height = 1024
    """Largest height that is chosen for a pair without a given height."""
    takes_holes = True
    """Whether a call may have the argument `holes`."""

    def __init__(
        self, config: SearchConfig | None = None, prior: NetworkPrior | None = None, name: str = "sweep"
    ) -> None:
        self.config, self.prior, self.name = config or SearchConfig(), prior, name
        digest = hashlib.blake2b(f"{self.config} {hash_sources(__name__)}".encode(), digest_size=8)
        self.fingerprint = f"sweep-{digest.hexdigest()}" + ("" if prior is None else f"-{prior.fingerprint}")
        """Hash of the settings and of the source code that computes the Gaussians; keys the prediction cache."""

    def __repr__(self) -> str:
        prior = "no weights" if self.prior is None else "guided by a depth network"
        return f"<{type(self).__name__} {self.name}: {prior}, panoramas of up to {self.default_height} rows by default>"

    def __call__(
        self,
        images: Float[Tensor, "*batch view 3 height width"],
        cam2world: Float[Tensor, "*batch view 4 4"],
        near: float | Tensor,
        far: float | Tensor,
        *,
        masks: Bool[Tensor, "*batch view height width"] | None = None,
        holes: Bool[Tensor, "*batch view height width"] | None = None,
    ) -> Gaussians | list[Gaussians]:
        """Predict from RGB in [0, 1] and OpenCV cam2world poses (metres); a list when there is a batch axis.

        Args:
            near, far: radial depth range, metres: numbers, or tensors with one value for each batch item or view; the
                range then covers all views.
            masks: True where a pixel shows the scene. Other pixels are not matched and have no Gaussians.
            holes: True where a scan, or a black cap, shows nothing; masked too.
        """
        if images.ndim == 5:
            bounds = [[select_item(bound, n) for n in range(len(images))] for bound in (near, far)]
            item_masks = ([None] * len(images) if stated is None else stated for stated in (masks, holes))
            items = zip(images, cam2world, *bounds, *item_masks, strict=True)
            return [self._predict(*item) for item in items]
        return self._predict(images, cam2world, near, far, masks, holes)

    def _predict(
        self,
        images: Tensor,
        cam2world: Tensor,
        near: float | Tensor,
        far: float | Tensor,
        masks: Tensor | None,
        holes: Tensor | None,
    ) -> Gaussians:
        low, high = float(torch.as_tensor(near).min()), float(torch.as_tensor(far).max())
        _check_inputs(images, cam2world, low, high, masks=masks, holes=holes)
        given = torch.ones(images[:, 0].shape, dtype=torch.bool) if masks is None else masks.cpu()
        # Holes are not matched, but fitted, so that Gaussians beside a hole do not reach into it; in a single view,
        # whose background layer continues there, they are not.
        matched = given if holes is None else given & ~holes.cpu()
        fitted = matched if len(images) == 1 else given
        _, fitted = fit_panoramas(images, fitted, _HEIGHT_MULTIPLE)
        images, matched = fit_panoramas(images, matched, _HEIGHT_MULTIPLE)
        posed = PosedImages(
            images=np.ascontiguousarray(images.detach().cpu().float().permute(0, 2, 3, 1).numpy()),
            cam2world=cam2world.detach().cpu().double().numpy(),
            masks=matched.numpy(),
            near=low,
            far=high,
        )
        with stage(0.57):  # fractions of the whole time, measured with the sample on two cores
            # Axes of the scene, planes, and of each view its neighbours and the depth that the prior model expects.
            scene = observe(posed, self.config, self.prior)
            # Inverse depth (h, 2h) of each view, at most `SearchConfig.finest_height` high.
            surfaces = search(scene)
        report_progress("placing Gaussians", 0.57)
        # A Gaussian for each point of the lattices (n); the photograph's height gives their spacing.
        gaussians = lift(posed, surfaces, scene.neighbours)
        report_progress("fitting colours", 0.76)
        # Colours (n, 1, 3) with which the Gaussians of each view draw its photograph.
        poses = torch.from_numpy(posed.cam2world)
        gaussians = fit_colors(gaussians, images.detach().cpu(), poses, fitted)
        report_progress("done", 1.0)
        return gaussians.to(device=images.device)


def _check_inputs(images: Tensor, cam2world: Tensor, near: float, far: float, **masks: Tensor | None) -> None:
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[0] < 1 or shape[1] != 3 or shape[3] != 2 * shape[2]:
        raise InputError(
            f"`images` must be (view, 3, height, 2 * height) of at least one panorama, got {shape}; "
            "stack RGB equirectangular images of one size"
        )
    require_matching_inputs(images, cam2world, **masks)
    require_working_world(cam2world, near, far)
