"""Render-and-compare after a prediction: the Gaussians are fitted to all photographs of the scene.

The Gaussians of a view are rasterised at its own camera and at the nearest others, and compared with those photographs.
So the images between the cameras, which deferred blending mixes from single views, are constrained from both sides.
Every step rasterises each view once: at its own camera in even steps, at one of the others in odd steps. In a scene for
joint drawing, a step rasterises the Gaussians of all views together at one camera, the cameras in turn.

Adam moves depth along the source ray, scales, rotations, opacities and colours; its step sizes fall along a cosine.
Twice in a run, Gaussians that are larger than a pixel are split where the error of the images is large. Blocks of the
photographs are held out of the loss. Their error decides when the last part of a run begins, which fits them too, and
whether the refined scene replaces the given one. In joint drawing a photograph shows mostly the Gaussians that come
from it, so that held-out blocks would say nothing, and there are none. Photographs do not show what becomes worse
between the cameras: of the given scene and the states of a run, the last one is kept whose pictures there agree about
as well with the photographs as those of the best.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gains, Gaussians, Scene
from pansplat.geometry.equirect import row_weights
from pansplat.geometry.pose import interpolate_poses, nearest_views
from pansplat.inputs.views import Views
from pansplat.refinement.adam import ParameterGroup
from pansplat.refinement.budget import DROP_ERROR, MAX_OTHERS, drop_unseen, merge_to
from pansplat.refinement.objective import Photograph, compare_places, image_difference
from pansplat.refinement.parameters import LEARNING_RATES, CameraParameters, ViewParameters
from pansplat.rendering import rasterize
from pansplat.rendering.color_fit import fit_colors
from pansplat.rendering.gains import equalize_gaussians, equalize_images, measure_gains
from pansplat.rendering.weights import sum_weights
from pansplat.system.progress import report_progress, stage
from pansplat.system.source_hash import hash_sources

# Largest height of the images that are compared, at least that of a display: fitted at the rows of the prediction,
# edges are rows of dots in larger images (docs/refinement.md). Colours are fitted at the photographs' own height.
DISPLAY_HEIGHT = 1024
_CONTRIBUTION_HEIGHT = 512  # largest height of the images by which Gaussians are merged and dropped
_HELD_OUT = 0.04  # fraction of the photographs' blocks that is not fitted until the release
_SPLIT_ERROR = 0.1  # pixels; a larger sum of errors times weights splits a Gaussian (docs/refinement.md)
# Decay of Adam's averages of the gradients and of their squares, by docs/what_was_tried.md. Wrong poses need long ones:
# own and other photographs contradict each other until the poses are corrected.
_BETAS, _POSE_BETAS = (0.5, 0.95), (0.9, 0.99)
# Adam's epsilon relative to the root mean square of the first gradients, for photographs that are compared at their own
# size; it grows with the number of their pixels. Gaussians of little effect move less.
_DAMPING = 0.2
_STEPS_PROGRESS = 0.65  # progress after the steps; the fit of colours takes the rest (the sample on two cores)
_RATE_FLOOR = 0.05  # factor of the learning rates at the end
_DISTANCE_PENALTY = 20.0  # weight of the mean squared change of the logarithms of distances
_POSE_PENALTY = 100.0  # weight of the squared corrections of poses, in radians and relative to the baseline
_RELEASE_AT = 0.75  # fraction of the run after which held-out blocks are fitted too
_HALF_WAY_HEIGHT = 64  # least rows of the pictures between the cameras, which have half of those of the prediction
_NUM_STATES = 4  # states of a run whose pictures between the cameras are compared
# Largest error of these pictures relative to the least one. Last states that are better, against the truth or to the
# eye, exceed it by up to 14.7 %; one with shards aside, of villa_8, by 17.5 % (docs/refinement.md).
_MAX_ERROR_RATIO = 1.15
_MIN_SEEN_WEIGHT = 1e-3  # pixels of half the height; a photograph sees a Gaussian whose blending weights sum to more
_CHECK_EVERY = 10  # steps between checks of the held-out error
_MIN_IMPROVEMENT = 0.002  # least relative decrease of the held-out error that is no stagnation
_PATIENCE = 3  # checks in a row with stagnation that end the steps
_POSE_TOLERANCE = 1e-3  # largest difference between entries of the poses of scene and photographs that are the same


@dataclass(frozen=True)
class RefineConfig:
    """Settings of a refinement."""

    gaussians: int | None = None
    """Largest number of Gaussians; None for no limit."""
    poses: bool = False
    """Whether small corrections of the poses are estimated."""
    splits: tuple[float, ...] = (0.2, 0.4)
    """Fractions of the run at which Gaussians are split."""

    def __post_init__(self) -> None:
        if self.gaussians is not None and self.gaussians < 1:
            raise InputError(f"`gaussians` must be at least 1, got {self.gaussians}")


@dataclass(frozen=True)
class RefineReport:
    """Result of a run.

    Attributes:
        steps, seconds: number of steps of the run, and its duration.
        kept: steps of the state that is kept; 0 for the given scene.
        stopped: why it ended: "done", "converged", "interrupted", "time limit", "single view", which is not refined, or
            why the given scene is kept: "worse", or "torn" between the cameras.
        before: mean absolute error of the held-out blocks at the start, of the scene within the limit of Gaussians.
        after: the same before the last part of the run, which fits these blocks, or at the end of a run without it.
    """

    steps: int
    kept: int
    seconds: float
    stopped: str
    before: float
    after: float


@dataclass(frozen=True)
class _Layer:
    """Views whose Gaussians are drawn together, and the photographs that they are compared with.

    Attributes:
        source: the only view, whose photograph is the first; None in joint drawing.
    """

    views: tuple[int, ...]
    photographs: tuple[int, ...]
    source: int | None = None


class Refinement:
    """A refinement of a scene, which `run` or single calls of `step` advance.

    Args:
        scene: with one input camera for each of the views.
        views: the photographs that the scene was predicted from, of any size. Only what is `shown` is compared.
        config: settings.
        seed: seed of the choice of held-out blocks.
    """

    @torch.inference_mode(False)  # the parameters need gradients, whatever the mode of the caller
    def __init__(self, scene: Scene, views: Views, config: RefineConfig | None = None, *, seed: int = 0) -> None:
        _check_fit(scene, views)
        self.config = config or RefineConfig()
        if self.config.poses and scene.joint:
            raise InputError(
                "poses need a scene with all Gaussians of each view, got one with each surface once; refine poses with "
                "layers first (`pansplat refine --layers --poses`)"
            )
        device, random = scene.gaussians.means.device, torch.Generator().manual_seed(seed)
        self._images = views.images.float().to(device)
        self._masks = views.masks.to(device)
        compared = views.shown.to(device)
        limit, height = self.config.gaussians, min(self._images.shape[-2], DISPLAY_HEIGHT)
        self._size = (height, 2 * height)
        self._contribution_size = (min(height, _CONTRIBUTION_HEIGHT), 2 * min(height, _CONTRIBUTION_HEIGHT))
        if limit is not None and len(scene.gaussians) > limit:
            scene = merge_to(scene, self._contribution_size, limit)
        self._start, poses = scene, scene.cam2world
        self._log_gains = measure_gains(scene.gaussians, self._images, poses, compared, joint=scene.joint)
        gaussians = equalize_gaussians(scene.gaussians, self._log_gains, poses)
        if scene.joint:
            self._start = dataclasses.replace(scene, gaussians=gaussians, gains=self.gains)
        equal = equalize_images(self._images, self._log_gains)
        held_out = 0.0 if scene.joint else _HELD_OUT
        self._photographs = [
            Photograph.split(image, mask > 0.999, held_out, random)
            for image, mask in zip(self._shrink(equal), self._shrink(compared[:, None].float())[:, 0], strict=True)
        ]
        self._half_way_height = min(max(scene.height // 2, _HALF_WAY_HEIGHT), self._size[0])
        self._small = [photograph.shrink(self._half_way_height) for photograph in self._photographs]
        self._views = {}
        for view in torch.unique(gaussians.views).tolist():
            near = nearest_views(poses, view, 1)
            # Layers are free: blended with those of other views, they may hold what only their own photograph shows.
            baseline = float((poses[near, :3, 3] - poses[view, :3, 3]).norm()) if scene.joint else 0.0
            self._views[view] = ViewParameters(gaussians.select(gaussians.views == view), poses[view, :3, 3], baseline)
        self._layers = [
            _Layer((view,), (view, *nearest_views(scene.cam2world, view, MAX_OTHERS)), view) for view in self._views
        ]
        if scene.joint:
            self._layers = [_Layer(tuple(self._views), tuple(range(len(scene.cam2world))))]
        self._cameras = CameraParameters(scene.cam2world.to(device), correct_poses=self.config.poses)
        self._groups, self._view_groups = self._group_parameters()
        self._steps = self._splits = 0
        self._seen: list[Tensor] = []
        self._kept, self._least_error = (0, self._start), math.inf  # the best state so far: steps, scene
        self._result: Scene | None = None

    def _shrink(self, images: Tensor) -> Tensor:
        """Images (n, c, h, w) at the size of the comparison, by area average."""
        return images if images.shape[-2:] == self._size else functional.interpolate(images, self._size, mode="area")

    def _group_parameters(self) -> tuple[list[ParameterGroup], list[ParameterGroup]]:
        """All groups, and those of them that hold the Gaussians: one for each of `ViewParameters.NAMES`."""
        rates, betas = LEARNING_RATES, _POSE_BETAS if self.config.poses else _BETAS
        groups = []
        if self.config.poses:
            groups.append(ParameterGroup([self._cameras.twists], rates["pose"], betas))
        views = self._views.values()
        names = ViewParameters.NAMES if views else ()
        of_views = [ParameterGroup([view.tensors[name] for view in views], rates[name], betas) for name in names]
        return groups + of_views, of_views

    @torch.inference_mode(False)
    @torch.enable_grad()
    def step(self, fraction: float) -> None:
        """Rasterise and compare each view once, or in joint drawing all views, and move the Gaussians.

        Args:
            fraction: progress of the run, in [0, 1]; sets the step sizes, and whether held-out blocks are fitted.
        """
        config = self.config
        if self._splits < len(config.splits) and config.splits[self._splits] <= fraction < _RELEASE_AT:
            self._splits += 1
            self._split()
        for group in self._groups:
            group.clear_gradients()
        rows: Sequence[Tensor] = ()  # rows that move, of the only layer of joint drawing; in other layers all move
        for layer in self._layers:
            target = self._choose_target(layer)
            photograph = self._photographs[target]
            weights = photograph.unmasked if fraction >= _RELEASE_AT else photograph.fitted
            gaussians = self._build(layer)
            moved = torch.cat([self._views[view].tensors["distance"] for view in layer.views])
            if layer.source is None:
                seen = self._find_seen(layer)[target]
                gaussians, moved = gaussians.select(seen), moved[seen]
                rows = seen.split([len(parameters) for parameters in self._views.values()])
            error = self._draw(gaussians, layer, target) - photograph.image
            (image_difference(error, weights) + _DISTANCE_PENALTY * moved.square().mean()).backward()
        if config.poses:
            (_POSE_PENALTY * self._cameras.twists.square().sum()).backward()
        pixels = self._images[0, 0].numel() / math.prod(self._size)
        for group in self._groups:
            group.clean_gradients()
            if not self._steps:
                group.set_damping(_DAMPING * pixels)
            group.step(_cosine_fall(fraction), rows if group in self._view_groups else ())
        for parameters in self._views.values():
            parameters.clamp()
        self._steps += 1

    def _choose_target(self, layer: _Layer) -> int:
        """The photograph that a layer is compared with in this step (see the module)."""
        own, *others = layer.photographs
        if layer.source is None:
            return layer.photographs[self._steps % len(layer.photographs)]
        return own if self._steps % 2 == 0 or not others else others[self._steps // 2 % len(others)]

    def _build(self, layer: _Layer) -> Gaussians:
        """The Gaussians of a layer, differentiable."""
        return Gaussians.cat([self._views[view].build() for view in layer.views])

    @torch.no_grad()
    def _find_seen(self, layer: _Layer) -> list[Tensor]:
        """Masks of a layer's Gaussians that each photograph shows. The others are not drawn: those of other rooms."""
        if not self._seen:
            gaussians, size = self._build(layer), (self._size[0] // 2, self._size[1] // 2)  # a quarter of the pixels
            for target in layer.photographs:
                pose = self._cameras.pose_in_view(layer.source, target)
                everywhere = torch.ones(size, device=gaussians.means.device)
                self._seen.append(sum_weights(gaussians, pose, everywhere) > _MIN_SEEN_WEIGHT)
        return self._seen

    @torch.no_grad()
    def _split(self) -> None:
        """Split the Gaussians with large errors, within the limit those with the largest."""
        if not self._views:
            return
        errors = torch.cat([self._errors(layer) for layer in self._layers])
        is_split, limit = errors > _SPLIT_ERROR, self.config.gaussians
        if limit is not None and len(errors) + int(is_split.sum()) > limit:
            is_split = errors > errors.topk(limit - len(errors) + 1).values[-1]
        counts = [len(parameters) for parameters in self._views.values()]
        for parameters, part in zip(self._views.values(), is_split.split(counts), strict=True):
            parameters.split(part)
        self._seen.clear()
        for group, name in zip(self._view_groups, ViewParameters.NAMES, strict=True):
            group.replace([parameters.tensors[name] for parameters in self._views.values()])

    def _errors(self, layer: _Layer) -> Tensor:
        """Error of each Gaussian of a layer: the absolute errors of the images times its blending weights, as a sum
        over pixels and a mean over photographs. It is 0 for a Gaussian that is smaller than a pixel at its own camera.
        """
        gaussians = self._build(layer)
        errors = torch.zeros_like(gaussians.opacities)
        pixels, half = math.prod(self._size), (self._size[0] // 2, self._size[1] // 2)  # a quarter of time and memory
        for target in layer.photographs:
            photograph = self._photographs[target]
            error = (self._draw(gaussians, layer, target) - photograph.image).abs().mean(0)
            error = functional.interpolate((error * photograph.fitted.pixels)[None, None], half, mode="area")[0, 0]
            error = error * pixels * (pixels / math.prod(half))  # a sum over pixels, of weights that sum to 1
            sums = sum_weights(gaussians, self._cameras.pose_in_view(layer.source, target), error)
            errors += sums / len(layer.photographs) * len(layer.views)
        cameras = self._cameras.cam2world[:, :3, 3].to(gaussians.means)
        distances = (gaussians.means - cameras[gaussians.views.long()]).norm(dim=1)
        return errors * (gaussians.scales.amax(1) > math.pi / self._size[0] * distances)

    def _draw(self, gaussians: Gaussians, layer: _Layer, target: int) -> Tensor:
        """The colours (3 height width) of a layer's Gaussians in a photograph."""
        return rasterize(gaussians, self._cameras.pose_in_view(layer.source, target), size=self._size).color

    @torch.no_grad()
    def held_out_error(self) -> float:
        """Mean absolute error of the held-out blocks, over all views and the photographs of other cameras.

        The colours may have been fitted to a view's own photograph; it counts if there is no other one. In joint
        drawing it is that of all pixels.
        """
        error = weight = 0.0
        for layer in self._layers:
            gaussians = self._build(layer)
            others = [target for target in layer.photographs if target != layer.source]
            for target in others or layer.photographs:
                photograph = self._photographs[target]
                difference = (self._draw(gaussians, layer, target) - photograph.image).abs().mean(0)
                compared = photograph.unmasked.pixels if self._start.joint else photograph.held_out
                error += float((difference * compared).sum())
                weight += float(compared.sum())
        return error / weight if weight > 0 else 0.0

    @torch.no_grad()
    def half_way_error(self) -> float:
        """Mean difference of pictures between neighbouring cameras from what their photographs show at the same places.

        A Gaussian in front of a surface, and a mixture of colours, differ from both photographs.
        """
        error = weight = 0.0
        poses, size = self._start.cam2world, (self._half_way_height, 2 * self._half_way_height)
        for layer in self._layers:
            gaussians = self._build(layer)
            neighbours = {tuple(sorted((view, *nearest_views(poses, view, 1)))) for view in layer.views}
            for (first, second), fraction in itertools.product(sorted(neighbours), (0.25, 0.5, 0.75)):
                pose = interpolate_poses(poses[first], poses[second], fraction)
                photographs = [(self._small[view], poses[view]) for view in (first, second)]
                difference, area = compare_places(rasterize(gaussians, pose, size=size), pose, photographs)
                error, weight = error + float((difference * area).sum()), weight + float(area.sum())
        return error / weight if weight > 0 else 0.0

    def _judge_state(self) -> None:
        """Keep the present state if its pictures between the cameras are about as good as those of the best."""
        error = self.half_way_error()
        if error <= _MAX_ERROR_RATIO * self._least_error:
            self._kept = (self._steps, self.scene() if self._steps else self._start)
        self._least_error = min(self._least_error, error)

    @torch.no_grad()
    def scene(self) -> Scene:
        """The scene in its present state.

        After a run it has no Gaussians without contribution. If the run made it worse before its last part, it is the
        scene at the start.
        """
        if self._result is not None or not self._views:
            return self._result or self._start
        parts = [self._cameras.move(parameters.build(), view) for view, parameters in self._views.items()]
        poses = torch.stack([self._cameras.corrected_pose(view) for view in range(len(self._photographs))])
        gaussians, poses = Gaussians.cat(parts), poses.to(self._start.cam2world)
        if not self._start.joint:  # the colours of a view are those of its photograph
            gaussians = equalize_gaussians(gaussians, -self._log_gains, poses)
        return dataclasses.replace(self._start, gaussians=gaussians, cam2world=poses, gains=self.gains)

    @property
    def gains(self) -> Gains:
        """Mean exposures of the photographs' channels relative to those of the joint colours."""
        area = row_weights(self._log_gains.shape[-2]).to(self._log_gains)[:, None]
        return tuple(tuple(row) for row in (-(self._log_gains * area).mean((2, 3)) / area.mean()).exp().tolist())

    @stage()
    def run(
        self,
        *,
        steps: int,
        seconds: float = math.inf,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> RefineReport:
        """Refine for a number of steps.

        The run goes over to its last part early if the held-out error stagnates. An object runs once. A single view is
        left as it is, within the limit of Gaussians.

        Args:
            steps: number of steps; the result is the same in every run on one machine.
            seconds: after which the run ends early, in the middle of its plan: the result then depends on the machine.
            should_stop: checked before each step; True ends the run early, with the better of both scenes as always.
        """
        if not (0 < steps < math.inf and seconds > 0):
            raise InputError(f"`steps` and `seconds` of a refinement must be positive, got {steps} and {seconds}")
        start, done, total = time.perf_counter(), 0, float(steps)
        if len(self._photographs) == 1:  # it does not show what is wrong seen from elsewhere
            self._result, error = self._start, self.held_out_error()
            return RefineReport(0, 0, time.perf_counter() - start, "single view", error, error)

        before = best = self.held_out_error()
        after: float | None = None  # measured when the release begins, which fits the held-out blocks
        stale, stopped, checked = 0, "done", 1
        self._judge_state()
        while self._views and (fraction := done / total) < 1:
            is_late = time.perf_counter() - start >= seconds
            if is_late or should_stop():
                stopped = "time limit" if is_late else "interrupted"
                break
            report_progress("refining", _STEPS_PROGRESS * fraction)
            if after is None and fraction >= _RELEASE_AT and not self._start.joint:
                after = self.held_out_error()
            if after is not None and after > before:
                break
            self.step(fraction)
            done += 1
            if checked / _NUM_STATES <= done / total < 1:
                checked += 1
                self._judge_state()
            if self._start.joint or done % _CHECK_EVERY or done / total >= _RELEASE_AT:
                continue
            error = self.held_out_error()
            stale = 0 if error < best * (1 - _MIN_IMPROVEMENT) else stale + 1
            best = min(best, error)
            if stale >= _PATIENCE:
                stopped, after, total = "converged", error, done / _RELEASE_AT  # the release begins now
        after = self.held_out_error() if after is None else after
        if after > before:
            self._kept, stopped = (0, self._start), "worse"
        elif done:
            self._judge_state()
            stopped = stopped if self._kept[0] else "torn"
        report_progress("fitting colours", _STEPS_PROGRESS)
        kept, self._result = self._kept
        self._free_parameters()
        if kept:
            detail = self._contribution_size[0] / self._images.shape[-2]  # large photographs need small Gaussians
            self._result = drop_unseen(self._result, self._contribution_size, detail * DROP_ERROR)
        if kept or self._start.joint:  # a fused scene has the colours of single photographs
            self._result = self._finish(self._result)
        report_progress("refined", 1.0)
        return RefineReport(done, kept, time.perf_counter() - start, stopped, before, after)

    def _free_parameters(self) -> None:
        """Free the parameters and the optimiser's state, which are gigabytes for millions of Gaussians."""
        self._views.clear()
        self._layers.clear()
        self._groups.clear()
        self._view_groups.clear()

    def _finish(self, scene: Scene) -> Scene:
        """Fit the colours to the photographs at their own size."""
        images = equalize_images(self._images, self._log_gains) if scene.joint else self._images
        colors = fit_colors(scene.gaussians, images, scene.cam2world, self._masks, joint=scene.joint)
        return dataclasses.replace(scene, gaussians=colors)


def _cosine_fall(fraction: float) -> float:
    """Factor of the step sizes, from 1 at fraction 0 to `_RATE_FLOOR` at fraction 1."""
    return _RATE_FLOOR + (1 - _RATE_FLOOR) * 0.5 * (1 + math.cos(math.pi * min(max(fraction, 0.0), 1.0)))


def refinement_fingerprint(config: RefineConfig | None = None) -> str:
    """Hash of the settings and of the source code of the refinement; part of the key of cached scenes."""
    settings = f"{config or RefineConfig()} {hash_sources('pansplat.refinement')}"
    return hashlib.blake2b(settings.encode(), digest_size=8).hexdigest()


def _check_fit(scene: Scene, views: Views) -> None:
    count = len(scene.cam2world)
    if not count:
        raise InputError("the scene has no input cameras, so it cannot be compared with photographs; refine a pair")
    if len(views.images) != count:
        raise InputError(f"the scene needs its {count} photographs to be refined, got {len(views.images)}")
    if not bool(torch.isfinite(views.images).all()):
        raise InputError("`views` must hold finite images, got NaN or infinity; read the photographs again")
    last = int(scene.gaussians.views.max()) if len(scene.gaussians) else 0
    if last >= count:
        raise InputError(f"the Gaussians must come from the scene's {count} views, got one of view {last}")
    difference = float((scene.cam2world.double() - views.cam2world.double()).abs().max())
    if not difference < _POSE_TOLERANCE:
        raise InputError(
            "the poses of the photographs must be those of the scene, got poses that differ by up to "
            f"{difference:.3g}; give the pair that the scene was predicted from"
        )
