"""Poses of panorama files: features, relations of pairs, the tour, up and scale (docs/poses.md)."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array

from pansplat.errors import InputError
from pansplat.images.image_files import read_height, read_mask, read_panorama
from pansplat.images.masks import scene_mask_of_files
from pansplat.inputs.panorama_sets import FAR, NEAR, find_mask
from pansplat.inputs.views import CAMERA_HEIGHT
from pansplat.poses.approximate import LinkedPlace, place_linked
from pansplat.poses.axes import NO_PRIOR, RotationPrior, SceneAxes, find_axes
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap, estimate_depth
from pansplat.poses.features import (
    DIAGONAL,
    FACE_ROTATIONS,
    Features,
    Matches,
    detect_features,
    drop_repeated,
    match_features,
)
from pansplat.poses.learned import (
    LEAST_COMMON,
    NO_LEARNED,
    LearnedFeatures,
    Matcher,
    detect_learned,
    load_matcher,
    match_learned,
)
from pansplat.poses.learned import default_weights as default_matcher
from pansplat.poses.link_directions import NO_LINKS, LinkDirections
from pansplat.poses.placing import DEPTH_HEIGHT, PlanFrame, make_piece
from pansplat.poses.tour import Group, IndexPair, build_tour
from pansplat.poses.two_view import Hypotheses, RelativePose, estimate_relative_pose, polish_relative_pose
from pansplat.poses.world import FLOOR_HEIGHT, depth_range, find_common_height, find_floors, level_poses
from pansplat.sweep.guided_sweep import list_default_weights
from pansplat.system.console import with_progress_bar
from pansplat.system.descriptions import describe_count, describe_range, list_first
from pansplat.system.devices import choose_device, say_detail
from pansplat.system.files import require_file, require_text
from pansplat.system.progress import report_progress, stage
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import Store, hash_file, hash_parts
from pansplat.system.threads import one_thread, worker_threads

_HEIGHT, _MIN_HEIGHT = 1024, 256  # largest and smallest number of rows that are worked with
# Which pairs are compared: chosen on tours of 10 to 30 generated panoramas.
_QUICK_FEATURES = 2500  # strongest features of a panorama, by which pairs are chosen
_THOROUGH = 6  # pairs of each panorama that are compared with all features, at most
_ALL_PAIRS_UP_TO = 3  # panoramas of which all pairs are compared with all features
_NEEDED_PAIRS = 4  # certain pairs of a panorama, above which no more are sought within its group
_LEAST_BATCH = 4  # pairs that are compared before others are chosen
_MATCHER_SECONDS = 1.5  # about the seconds of the learned matcher for a panorama, on two cores
_PAIR_TIME = 1.3  # time of a comparison over that of the features of a panorama, for the progress bar
_MASK_KEPT_SHARE = 0.6  # the common mask stays when others are added to so large a share of the panoramas
# What cannot be used; grey values are 0 to 255.
_BLANK_BRIGHTNESS = 8.0  # mean grey value of an image that shows nothing
_LARGEST_SEAM, _POLE_DEVIATION = 12.0, 10.0  # largest difference across the edges, and deviation along a pole's row
_SAME_IMAGE = 1.5  # largest mean difference of two copies of one image
# Expected numbers of right matches.
_ENOUGH_SIFT_MATCHES, _COUNTED_PRIOR = 100.0, 0.3  # above which LightGlue is left out; least probability that counts
_MIRROR_EVIDENCE = 60.0  # least number of matches with a mirror image
_MIRROR_RATIO = 1.5  # least ratio to that with the picture itself; symmetric things match either way
# Learned matches of one pair of faces depend on each other, so that each counts less than its probability.
_LEARNED_PRIOR, _LEARNED_NOISE, _LEARNED_SIZE = 0.7, 1.6e-3, 7.0  # largest prior; noise, radians; size, pixels
_MAX_BASELINE = 1e9  # metres
_LEAST_NEAR, _LARGEST_NEAR, _MIN_FAR = 0.1, 0.6, 6.0  # metres; the depth range is not narrower than that of rooms
_ADVICE = (
    "take one more photograph between those that share too little, or in the open door, or place them by hand in "
    "pansplat-view"
)


@dataclass(frozen=True, eq=False)
class PoseGroup:
    """Panoramas whose relative poses are known.

    Attributes:
        poses: cam2world, OpenCV axes, world y down, metres.
        near, far: depth range of the group's points, metres.
        residual: median angle between points and bearings, degrees.
        scale_source: how the unit was found, for messages.
        unit: metres that are one camera height of the estimated depths.
    """

    poses: dict[Path, Float[Array, "4 4"]]
    near: float
    far: float
    residual: float
    scale_source: str
    unit: float = CAMERA_HEIGHT

    def __repr__(self) -> str:
        return (
            f"<PoseGroup: {describe_count(len(self.poses), 'panorama')} ({list_first([p.name for p in self.poses])}), "
            f"near and far {describe_range(self.near, self.far, 'm')}, residual {self.residual:.2f} degrees>"
        )


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Estimated poses, with the figures of their check.

    Attributes:
        images: the files that were read.
        groups: panoramas that reliable pairs connect, the largest group first; each has a world of its own.
        unplaced: the reason for each file without a pose.
        relations: relative poses of the pairs that were compared.
        names: what messages call the files; by default their own names.
        approximate: about where files without a pose are, by links.
    """

    images: tuple[Path, ...]
    groups: tuple[PoseGroup, ...]
    unplaced: dict[Path, str]
    relations: dict[tuple[Path, Path], RelativePose]
    names: Mapping[Path, str] = field(default_factory=dict)
    approximate: Mapping[Path, LinkedPlace] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<PoseEstimate: {self.summary}>"

    @property
    def poses(self) -> dict[Path, Float[Array, "4 4"]]:
        """The poses, cam2world, of the panoramas of the largest group."""
        return self.groups[0].poses

    def name_of(self, image: Path) -> str:
        """The name of a file, for messages."""
        return self.names.get(image, image.name)

    @property
    def apart(self) -> dict[Path, str]:
        """For each file of a smaller group, a sentence that names the others of its group."""
        found = {}
        for group in self.groups[1:]:
            for image in group.poses:
                others = ", ".join(self.name_of(other) for other in group.poses if other != image)
                found[image] = f"it has a pose with {others} only"
        return found

    @property
    def summary(self) -> str:
        """One line: how many panoramas have a pose, and the figures of the check."""
        used = [relation for relation in self.relations.values() if relation.is_reliable]
        probable = sum(not relation.is_certain for relation in used)
        placed = sum(len(group.poses) for group in self.groups)
        groups = f" in {len(self.groups)} groups" if len(self.groups) > 1 else ""
        if not self.groups:
            return "no panorama has a pose"
        residual = max(group.residual for group in self.groups)
        return (
            f"{placed} of {len(self.images)} panoramas have a pose{groups}, by {describe_count(len(used), 'pair')}"
            + (f", of which {probable} are probable only" if probable else "")
            + f"; residual {residual:.2f} degrees; scale: {self.groups[0].scale_source}"
        )


@dataclass(frozen=True, eq=False)
class _View:
    """What is used of a panorama.

    Attributes:
        features: SIFT on faces along the camera's axes.
        turned: the same, of faces turned against the walls.
        learned: features of the learned matcher.
        axes: gravity and walls.
        small: grey, for the search of the floor.
        surroundings: all that it shows, with estimated depth.
        key: hash of all that this was computed from.
    """

    features: Features
    turned: Features
    learned: LearnedFeatures
    axes: SceneAxes
    small: Float[Array, "height width"]
    surroundings: Surroundings
    key: str = ""

    @functools.cached_property
    def matched(self) -> Features:
        """The features from which the pose of a pair is estimated."""
        count = len(self.learned)
        return self.features.joined(
            Features(
                self.learned.bearings,
                np.zeros((count, self.features.descriptors.shape[1]), np.float32),
                np.full(count, _LEARNED_SIZE),
                np.full(count, _LEARNED_NOISE),
            )
        )

    @functools.cached_property
    def joined(self) -> Features:
        """The features of `matched`, and those of the faces turned against the walls."""
        return self.matched.joined(self.turned)

    @functools.cached_property
    def mirrored(self) -> _View:
        """The view of the panorama that is mirrored left to right; its gravity and walls are not used."""
        return replace(
            self, features=self.features.mirrored(), learned=NO_LEARNED, surroundings=self.surroundings.mirrored()
        )


@with_progress_bar
def estimate_poses(
    images: Sequence[Path | str],
    *,
    masks: Mapping[Path, Path | None] | None = None,
    links: Mapping[Path, Mapping[Path, float]] | None = None,
    names: Mapping[Path, str] | None = None,
    camera_height: float = CAMERA_HEIGHT,
    baseline: tuple[Path | str, Path | str, float] | None = None,
    cache_folder: Path | None = None,
) -> PoseEstimate:
    """Camera poses of two or more equirectangular panoramas of one home or site.

    Args:
        images: files, 2:1; one that is repeated is used once.
        masks: the mask file of each image, if it has one; by default those beside the images (docs/input.md).
        links: for an image, the yaw at which a tour links to other images, radians to the right of the centre.
        names: what messages call the images; by default the names of the files.
        camera_height: mean height of the cameras over the floor, metres; it sets the scale if the floor is found.
        baseline: two of the images of the largest group and their distance in metres, instead of the camera's height.
        cache_folder: folder whose cache keeps features and relative poses, so that a further panorama costs its own
            only; none by default.

    Returns:
        The poses of the panoramas that could be placed; those that could not are named with the reason.

    Raises:
        NoPosesError: no two panoramas could be placed.
    """
    paths = tuple(dict.fromkeys(Path(image) for image in images))
    names = {path: path.name for path in paths} | dict(names or {})
    if len(paths) < 2:
        raise InputError(f"needed two or more different panoramas to estimate poses, got {len(paths)}; add one.")
    for path in paths:
        require_file(path, "a panorama")
        require_text(path)
    if not 0 < camera_height < math.inf:
        raise InputError(f"`camera_height` must be a positive number of metres, got {camera_height}")
    if baseline is not None:
        ends = {_find_file(name, paths, names, "the images") for name in baseline[:2]}
        if len(ends) < 2 or not 0 < baseline[2] < _MAX_BASELINE:
            raise InputError(
                f"`baseline` must be two different images and a distance above 0 to {_MAX_BASELINE:g} metres, got "
                f"{' '.join(map(str, baseline))}"
            )
    pixels, reasons = _read_images(paths, names)
    kept = list(pixels)
    if len(kept) < 2:
        raise _no_poses(paths, reasons | dict.fromkeys(kept, "no other panorama is left"), names)
    with one_thread():  # panoramas and pairs are divided among threads
        masks = {path: find_mask(path, path.parent) for path in paths} if masks is None else masks
        cache = Store(cache_folder, _CACHED)
        count = len(kept)
        matcher = load_matcher(choose_device("learned matcher", count * _MATCHER_SECONDS))
        split = 0.9 * count / (count + _PAIR_TIME * min(count * (count - 1) / 2, count * _THOROUGH / 2))
        with stage(split):
            views = _describe_views(pixels, masks, matcher, cache)
        links = links or {}
        yaws = {
            (i, j): LinkDirections(links.get(a, {}).get(b), links.get(b, {}).get(a))
            for (i, a), (j, b) in itertools.combinations(enumerate(kept), 2)
        }
        with stage(0.9):
            relations = _relate_views(views, yaws, matcher, cache)
    report_progress("placing the panoramas", 0.9)
    downs = np.stack([v.axes.axes[0] if v.axes.has_down else np.full(3, np.nan) for v in views])
    noise = max(float(np.median(v.features.noise)) if len(v.features) else 0.0 for v in views)
    tour = build_tour([v.joined for v in views], relations, downs, noise)
    placed, listed = [position for group in tour.groups for position in group.placed], [names[path] for path in kept]
    for position, (reason, other, figures) in tour.unplaced.items():
        partner = "" if other is None else f" (it has most in common with {listed[other]})"
        if figures:
            say_detail(f"{listed[position]} and {listed[other]}", figures)
        reasons[kept[position]] = _describe_mirrored(position, views, placed, listed) or reason + partner
    if not tour.groups:
        raise _no_poses(paths, reasons, names, _place_linked(views, kept, links, ()))
    report_progress("finding the floor", 0.95)
    groups = [
        _finish_group(
            group,
            level_poses(group.poses, downs[list(group.placed)]),
            [kept[position] for position in group.placed],
            [views[position].small for position in group.placed],
            names,
            camera_height,
            baseline if number == 0 else None,
        )
        for number, group in enumerate(tour.groups)
    ]
    return PoseEstimate(
        paths,
        tuple(groups),
        {path: reasons[path] for path in paths if path in reasons},
        {(kept[i], kept[j]): relation for (i, j), relation in (relations | tour.confirmed).items()},
        names,
        _place_linked(views, kept, links, groups),
    )


def _place_linked(
    views: Sequence[_View],
    files: Sequence[Path],
    links: Mapping[Path, Mapping[Path, float]],
    groups: Sequence[PoseGroup],
) -> dict[Path, LinkedPlace]:
    """About where the files without a pose are."""
    pieces = {file: make_piece(view.surroundings, view.axes) for file, view in zip(files, views, strict=True)}
    worlds = []
    for group in groups:
        poses = {file: pose / np.array((1, 1, 1, group.unit)) for file, pose in group.poses.items()}  # camera heights
        frame = PlanFrame.of_world(np.stack(list(poses.values())), 1.0)
        worlds.append({file: frame.find_place(pose, pieces[file].upright) for file, pose in poses.items()})
    return place_linked(pieces, links, worlds)


def _finish_group(
    group: Group,
    poses: Float[Array, "view 4 4"],
    files: Sequence[Path],
    images: Sequence[Array],
    names: Mapping[Path, str],
    camera_height: float,
    baseline: tuple[Path | str, Path | str, float] | None,
) -> PoseGroup:
    """The group in metres."""
    scale, source = _find_scale(files, poses, images, names, camera_height, baseline)
    poses[:, :3, 3] *= scale
    near, far = depth_range(group.depths * scale) or (NEAR, FAR)
    return PoseGroup(
        dict(zip(files, poses, strict=True)),
        min(max(near, _LEAST_NEAR), _LARGEST_NEAR),
        max(far, _MIN_FAR),
        float(np.degrees(np.median(group.angles))) if len(group.angles) else 0.0,
        source,
        scale,
    )


class NoPosesError(InputError):
    """No two panoramas could be placed.

    Attributes:
        reasons: for each file.
        approximate: about where files are, relative to each other.
    """

    def __init__(
        self,
        reasons: Mapping[Path, str],
        names: Mapping[Path, str] | None = None,
        approximate: Mapping[Path, LinkedPlace] | None = None,
    ) -> None:
        listed = "; ".join(f"{(names or {}).get(path, path.name)}: {reason}" for path, reason in reasons.items())
        advice = "" if approximate is None else f"; {_ADVICE}"
        super().__init__(f"no poses were found: {listed}{advice}.")
        self.reasons, self.approximate = dict(reasons), approximate or {}


def _no_poses(
    paths: Sequence[Path],
    reasons: Mapping[Path, str],
    names: Mapping[Path, str],
    approximate: Mapping[Path, LinkedPlace] | None = None,
) -> NoPosesError:
    return NoPosesError({path: reasons[path] for path in paths}, names, approximate)


def _read_images(
    paths: Sequence[Path], names: Mapping[Path, str]
) -> tuple[dict[Path, UInt8[Array, "height width"]], dict[Path, str]]:
    """Grey panoramas, and the reasons against those that cannot be used."""
    pixels: dict[Path, Array] = {}
    reasons: dict[Path, str] = {}
    thumbnails: dict[Path, Array] = {}
    for path in paths:
        try:
            image = read_panorama(path, _working_height(path))[0].numpy()
        except InputError as error:
            reasons[path] = str(error).removeprefix(f"{path}: ").rstrip(".")
            continue
        grey = cv2.cvtColor((image.transpose(1, 2, 0) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, (128, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
        copy = next((name for name, other in thumbnails.items() if np.abs(small - other).mean() < _SAME_IMAGE), None)
        if grey.mean() < _BLANK_BRIGHTNESS:
            reasons[path] = f"too dark (mean grey value {grey.mean():.0f} of 255)"
        elif small.std() < 2:
            reasons[path] = "it shows nothing (one colour)"
        elif not _is_closed(grey):
            reasons[path] = "it is not a panorama of 360 degrees: its left and right edges do not join"
        elif copy is not None:
            reasons[path] = f"it is a copy of {names[copy]}, or was taken at the same place"
        else:
            pixels[path], thumbnails[path] = grey, small
    return pixels, reasons


def _is_closed(grey: UInt8[Array, "height width"]) -> bool:
    """Whether the left and right edges join, or the rows at the poles have one colour, as in a panorama."""
    small = cv2.resize(grey, (512, 256), interpolation=cv2.INTER_AREA).astype(np.float32)
    inside = np.abs(np.diff(small, axis=1)).mean(axis=0)
    seam = float(np.abs(small[:, 0] - small[:, -1]).mean())
    poles = min(float(small[row].std()) for row in (0, -1))
    return seam < max(_LARGEST_SEAM, 3 * float(np.quantile(inside, 0.97))) or poles < _POLE_DEVIATION


def _working_height(path: Path) -> int:
    """The height of an image, at most `_HEIGHT`; enlarged images would have a wrong noise."""
    return min(max(read_height(path), _MIN_HEIGHT), _HEIGHT)


def _describe_views(
    pixels: Mapping[Path, UInt8[Array, "height width"]],
    masks: Mapping[Path, Path | None],
    matcher: Matcher,
    cache: Store,
) -> list[_View]:
    hashes = {path: hash_parts(fingerprint_estimates(), grey) for path, grey in pixels.items()}
    static = _find_scene_mask(hashes, cache)

    def look_up(path: Path) -> _View:
        mask = masks.get(path)
        scene = static if mask is None else read_mask(mask, _HEIGHT).numpy()
        # Read again: a float image has 25 MB, too many to keep those of all panoramas.
        pixels_of_view, opaque = read_panorama(path, len(pixels[path]))
        if not opaque.all():
            scene = scene & (cv2.resize(opaque.numpy().astype(np.uint8), scene.shape[::-1]) > 0)
        image = pixels_of_view.permute(1, 2, 0).numpy()
        key = hash_parts(hashes[path], image, np.packbits(scene))
        return cache.get("view", key, lambda: describe(path, key, scene, image))

    def describe(path: Path, key: str, scene: Array, image: Array) -> _View:
        grey = pixels[path]
        small = cv2.resize(grey, (2 * FLOOR_HEIGHT, FLOOR_HEIGHT), interpolation=cv2.INTER_AREA) / np.float32(255)
        axes = find_axes(grey)
        turned = detect_features(grey, scene, rotations=axes.frame @ DIAGONAL @ FACE_ROTATIONS, faces=4)
        learned = detect_learned(matcher, (image * 255).astype(np.uint8), scene, axes.frame)
        shown = cv2.resize(image, (2 * DEPTH_HEIGHT, DEPTH_HEIGHT), interpolation=cv2.INTER_AREA)
        depth = estimate_depth(shown, axes.axes[0] if axes.has_down else None)
        return _View(detect_features(grey, scene), turned, learned, axes, small, Surroundings(shown, depth), key)

    views = []
    with worker_threads() as pool:
        for view in pool.map(look_up, pixels):
            views.append(view)
            report_progress("finding features", len(views) / len(pixels))
    return views


@dataclass(frozen=True, eq=False)
class _SceneMask:
    """Where panoramas show the scene and not what is fixed to the camera.

    Attributes:
        hashes: hashes of the grey panoramas.
        bits: the mask, packed.
    """

    hashes: tuple[str, ...]
    bits: UInt8[Array, "byte"]


_CACHED = (_View, _SceneMask, Features, LearnedFeatures, SceneAxes, Surroundings, DepthMap, RelativePose, Hypotheses)


def _find_scene_mask(hashes: Mapping[Path, str], cache: Store) -> Bool[Array, "height width"]:
    """Where the panoramas show the scene; as found before, if most of them are those of before.

    So the features of these stay when others are added.
    """

    def detect() -> _SceneMask:
        return _SceneMask(tuple(hashes.values()), np.packbits(scene_mask_of_files(tuple(hashes), _HEIGHT).numpy()))

    earlier = [mask for mask in cache.list_values("mask") if set(mask.hashes) <= set(hashes.values())]
    best = max(earlier, key=lambda mask: len(mask.hashes), default=None)
    if best is None or len(best.hashes) < _MASK_KEPT_SHARE * len(hashes):
        best = cache.get("mask", hash_parts(*hashes.values()), detect)
    return np.unpackbits(best.bits, count=2 * _HEIGHT**2).reshape(_HEIGHT, 2 * _HEIGHT).astype(bool)


def _relate_views(
    views: Sequence[_View], links: Mapping[IndexPair, LinkDirections], matcher: Matcher, cache: Store
) -> dict[IndexPair, RelativePose]:
    """Relative poses of the pairs that have most in common, and of those that links connect.

    Pairs are compared in the order of what they have in common. Those within a group that certain pairs connect are
    left out if both panoramas have enough of them.
    """
    pairs = list(itertools.combinations(range(len(views)), 2))
    overlap: dict[IndexPair, float] = {}
    if len(views) > _ALL_PAIRS_UP_TO:
        report_progress("comparing all pairs", 0.0)
        with worker_threads() as pool:
            quick = pool.map(lambda pair: _quick_overlap(views[pair[0]].features, views[pair[1]].features), pairs)
            overlap.update(zip(pairs, quick, strict=True))
        chosen = {pair for pair, directions in links.items() if directions != NO_LINKS}
        for view in range(len(views)):
            own = sorted((pair for pair in pairs if view in pair), key=lambda pair: -overlap[pair])
            chosen |= set(own[:_THOROUGH])
        pairs = sorted(chosen, key=lambda pair: (-overlap[pair], pair))

    def relate(pair: IndexPair) -> RelativePose:
        first, second = views[pair[0]], views[pair[1]]
        matches = _match(first, second, matcher, is_linked=links[pair] != NO_LINKS)
        prior = RotationPrior(first.axes, second.axes)
        relation = _estimate_pair(first, second, matches, prior, links[pair])
        if not (relation.is_reliable or relation.is_doubtful):
            return relation
        if relation.is_reliable and _is_mirrored(first, second, overlap.get(pair), relation):
            return replace(relation, problem="one of both looks mirrored left to right", hypotheses=Hypotheses())
        if not relation.is_matched:
            return relation
        further = match_features(first.turned, second.turned)
        every = matches.joined(further.shifted(len(first.matched), len(second.matched)))
        return polish_relative_pose(relation, first.joined, second.joined, every, prior)

    def look_up(pair: IndexPair) -> RelativePose:
        first, second = views[pair[0]], views[pair[1]]
        key = hash_parts(first.key, second.key, str(links[pair]))
        return cache.get("pair", key, lambda: relate(pair))

    groups, counts = list(range(len(views))), [0] * len(views)  # what certain pairs connect; certain pairs of each view

    def is_needed(pair: IndexPair) -> bool:
        i, j = pair
        if groups[i] != groups[j] or links[pair] != NO_LINKS:
            return True
        return min(counts[i], counts[j]) < _NEEDED_PAIRS

    relations: dict[IndexPair, RelativePose] = {}
    with worker_threads() as pool:
        size = max(len(views) // 2, _LEAST_BATCH)  # the same one for any number of threads
        for start in range(0, len(pairs), size):
            batch = [pair for pair in pairs[start : start + size] if is_needed(pair)]
            for number, (pair, relation) in enumerate(zip(batch, pool.map(look_up, batch), strict=True)):
                relations[pair] = relation
                report_progress("comparing pairs", (start + number + 1) / len(pairs))
                if relation.is_certain:
                    i, j = pair
                    groups = [groups[i] if group == groups[j] else group for group in groups]
                    counts[i], counts[j] = counts[i] + 1, counts[j] + 1
    return relations


def fingerprint_estimates() -> str:
    """A hash of the code and of the weights that poses are estimated by."""
    files = *list_default_weights(), default_matcher()
    return hash_parts(hash_sources(__name__), *map(hash_file, files))


def _match(first: _View, second: _View, matcher: Matcher, *, is_linked: bool = False) -> Matches:
    """Matches of `matched` features: by SIFT, and by the learned matcher where those hardly suffice."""
    matches = match_features(first.features, second.features)
    if matches.prior[matches.prior > _COUNTED_PRIOR].sum() > _ENOUGH_SIFT_MATCHES:
        return matches
    found = match_learned(matcher, first.learned, second.learned, least_common=0 if is_linked else LEAST_COMMON)
    learned = Matches(found.indices, np.minimum(found.prior, _LEARNED_PRIOR))
    every = matches.joined(learned.shifted(len(first.features), len(second.features)))
    return drop_repeated(first.matched, second.matched, every)


def _estimate_pair(
    first: _View,
    second: _View,
    matches: Matches,
    prior: RotationPrior = NO_PRIOR,
    links: LinkDirections = NO_LINKS,
) -> RelativePose:
    """The relative pose of two views."""
    surroundings = first.surroundings, second.surroundings
    return estimate_relative_pose(first.matched, second.matched, matches, prior, surroundings, links)


def _describe_mirrored(view: int, views: Sequence[_View], placed: Sequence[int], names: Sequence[str]) -> str | None:
    """The problem of a panorama whose mirror image fits another one; None if it does not."""
    others = placed or [other for other in range(len(views)) if other != view]
    for other in sorted(others, key=lambda v: abs(v - view))[:3]:
        if _is_mirrored(views[view], views[other]):
            if placed:
                return "it looks mirrored left to right; flip it"
            return f"this one or {names[other]} looks mirrored left to right; flip one"
    return None


def _is_mirrored(
    first: _View, second: _View, overlap: float | None = None, relation: RelativePose | None = None
) -> bool:
    """Whether the mirror image of one panorama has more in common with the other one than it has itself.

    Args:
        overlap: `_quick_overlap` of both, if known.
        relation: relative pose of both; the mirror image must fit better.
    """
    mirrored = first.mirrored
    evidence = _quick_overlap(mirrored.features, second.features)
    if evidence < _MIRROR_RATIO * (_quick_overlap(first.features, second.features) if overlap is None else overlap):
        return False
    matches = match_features(mirrored.features, second.features)
    if matches.prior.sum() < _MIRROR_EVIDENCE:
        return False
    found = _estimate_pair(mirrored, second, matches)
    return found.is_reliable and (relation is None or found.score > relation.score)


def _quick_overlap(first: Features, second: Features) -> float:
    """Expected number of right matches among the strongest features."""
    matches = match_features(first.strongest(_QUICK_FEATURES), second.strongest(_QUICK_FEATURES))
    return float(matches.prior.sum())


def _find_scale(
    files: Sequence[Path],
    poses: Float[Array, "view 4 4"],
    images: Sequence[Array],
    names: Mapping[Path, str],
    camera_height: float,
    baseline: tuple[Path | str, Path | str, float] | None,
) -> tuple[float, str]:
    """Metres per unit of the poses, and how it was found."""
    centres = poses[:, :3, 3]
    if baseline is not None:
        ends = [_find_file(name, files, names, "the largest group of images with poses") for name in baseline[:2]]
        distance = float(np.linalg.norm(centres[ends[0]] - centres[ends[1]]))
        if distance == 0:
            raise InputError(f"`baseline` must be two images with a distance, got two from the same place: {baseline}")
        first, second = (names[files[end]] for end in ends)
        return baseline[2] / distance, f"{first} and {second} are {baseline[2]:g} m apart"
    found = find_common_height(find_floors(images, poses, camera_height))
    height, doubt = (1.0, "no floor was found, so by estimated depth") if found is None else found
    source = f"cameras {camera_height:g} m over the floor"
    if doubt is not None:
        source += f" (uncertain: {doubt}; set --camera-height or --baseline of `pansplat pose`)"
    return camera_height / height, source


def _find_file(name: Path | str, files: Sequence[Path], names: Mapping[Path, str], which: str) -> int:
    for key in (str, attrgetter("name"), attrgetter("stem"), names.__getitem__):
        found = [n for n, file in enumerate(files) if key(file) == str(name)]
        if len(found) > 1:
            several = list_first([str(files[n]) for n in found])
            raise InputError(f"`baseline` must name one image each, got {name}, which may be {several}; give the path")
        if found:
            return found[0]
    listed = ", ".join(names[file] for file in files)
    raise InputError(f"`baseline` must name two of {which} ({listed}), got {name}")
