"""The relative pose of two panoramas from matches of which most may be wrong.

Each match is evidence: the logarithm of the likelihood of its epipolar angle under a pose, over its likelihood by
chance. The prior probability that a match is right follows from its ratio. The sum over all matches, the score, ranks
the hypotheses of the minimal solvers, and measures whether the best one can be chance. Hypotheses come from three
matches of levelled cameras, from two with parallel walls, from five if gravity is unknown, and by estimated depth
(`proposals`).

Source: M. Fischler, R. Bolles, Random Sample Consensus, CACM 1981; O. Chum, J. Matas, O. Obdrzalek, Enhancing RANSAC
by generalized model optimization, ACCV 2004; P. Torr, A. Zisserman, MLESAC, CVIU 2000.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from pansplat.poses.axes import NO_PRIOR, RotationPrior
from pansplat.poses.dense import Surroundings, compare
from pansplat.poses.depth import MatchDepths
from pansplat.poses.features import Features, Matches
from pansplat.poses.link_directions import NO_LINKS, LinkDirections
from pansplat.poses.proposals import propose_by_depth
from pansplat.poses.solvers import (
    Bearings,
    Rotation,
    Vector,
    angle_between,
    compiled,
    cross,
    decompose_essential,
    epipolar_angles,
    essential_from_five,
    make_motion,
    rotation_angle,
    rotation_exp,
    skew,
    two_view_depths,
    upright_from_three,
)

# Limits are chosen on the 78 pairs of zind, and numbers of samples on tours of generated homes (docs/poses.md).
_WIDE_SHARE, _WIDE = 0.3, 3.0  # share of right matches with a larger error, and how many times larger it is
_MAX_ANGLE = 4.0  # matches with a larger residual are wrong; in deviations of the larger error
_DISTORTION, _DISTORTION_LENGTH = 1e-3, 0.15  # stitching: standard deviation and correlation length, radians
_TAIL = 2.0  # degrees of freedom of Student's t, the distribution of a match's own error in the polish
_MAX_POLISHED, _MIN_POLISHED = 1000, 8  # largest and smallest number of matches of the polish
_MIN_PROBABILITY = 0.2  # matches that are less probably right have no part in the polish
_POLISH_SIZE = 7.0  # pixels; a feature of this size has 1.4 times the noise of a small one
_POLISH_WINDOW = 0.035  # largest residual, radians; what lies beyond the noise gives the density of wrong matches
_POLISH_FACTORS, _POLISH_STEPS = (4, 2, 1), 4  # the noise is enlarged by each factor in turn, for so many steps
_SHARE_STEPS = 4  # rounds of expectation and maximisation that find the shares of right matches
_POLISH_PRIORS = np.array((0.667, 0.45, 0.15, 0.06, 0.02, 0.0125))  # limits of the prior between groups of matches
_POLISH_SHARES = np.array((0.9, 0.8, 0.6, 0.4, 0.25, 0.12, 0.06))  # share of right matches in each group, a priori
_POLISH_WEIGHT = 4.0  # the shares a priori count like so many matches
_CALIBRATION = 1.5, 80.0  # formal standard deviations are multiplied by the larger of 1.5 and 80 / places
_MIN_MATCHES, _MAX_MATCHES = 8, 2500  # smallest and largest number of matches that a pose is sought from
_TOP_SETS = (40, 80, 160, 320, 640, 2500)  # samples are drawn from so many best matches
_SAMPLES = {5: 150, 3: 1200, 2: 600}  # number of samples from each set, by the matches in a sample
_QUICK, _RESCORED = 500, 3000  # best matches that rank all hypotheses; hypotheses that all matches rank
_LEVEL = [2, 0, 1]  # order of the axes in a levelled camera: x, y down, z
_KEPT, _KEPT_PARALLEL = 10, 6  # hypotheses that are optimised: all kinds of samples, and those with parallel walls
_PLACE = 0.2  # size of a cell that counts as one place, as a difference of unit vectors
_MIN_PARALLAX = 5.0  # least parallax of two places, in standard deviations of the noise
_MAX_UNCERTAINTY = math.radians(4)  # largest standard deviation of the direction
# Hypotheses are optimised with the noise enlarged by each factor in turn: of samples, with parallel walls, by depth.
_FACTORS, _PARALLEL_FACTORS, _DEPTH_FACTORS = (2, 1), (4, 2, 1), (24, 6, 2, 1)
_SAME_ROTATION, _SAME_DIRECTION = math.radians(3), math.radians(10)  # equal hypotheses differ by less
_SAME_ESSENTIAL = 0.998  # cosine of two essential matrices as vectors, above which they are equal (3.6 degrees)
_COMPARED_ESSENTIALS = 2000  # best essential matrices among which different ones are sought
# Matches that suffice without a comparison: repeated doors and windows give wrong poses up to 26 places.
_NEEDED_PLACES, _NEEDED_SCORE, _NEEDED_MARGIN = 32, 80, 20
_COMPARED = 16  # best hypotheses whose panoramas are compared
# Logarithm of the odds of a hypothesis against none, linear in: 1, log(1 + score), log(1 + places), parallel walls,
# log(0.003 + conflict), likeness, shade and hue with their weight, overlap, log(0.01 + slope of the translation),
# whether it is that of a comparison. Fitted to 287 pairs (docs/poses.md).
_ODDS = (-32.94, 0.73, 1.39, 3.95, -2.41, 7.65, -0.38, 4.57, -0.75, -1.73, -1.7)
_LEAST_CONFLICT, _LEAST_SLOPE, _LARGEST_SLOPE = 0.003, 0.01, 0.3
_NEAR = math.radians(4), 0.25, 0.15  # poses are one within: rotation; translation, camera heights, or relative
_PREFERENCE = 2.0  # a pose by matches wins over a proposal whose log-odds are higher by less
_PROPOSAL_NOISE = math.radians(0.5), 0.1  # standard deviations of a proposal: rotation; position, camera heights
_CERTAIN_ODDS, _PROBABLE_ODDS, _DOUBTFUL_ODDS = 2.0, 1.0, -2.0  # least log-odds of each
_SHOWN_ODDS = 0.0  # above which messages state the probability; a pose that is rather wrong than right has none


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A relative pose x2 = R x1 + t with |t| = 1, and its evidence.

    Attributes:
        score: natural logarithm of the likelihood ratio against chance.
        probability: probability of each match to be right.
        distance: camera heights between the cameras, by the estimated depths; NaN if they do not state it.
        is_proposed: whether it is the pose of a comparison of both panoramas, not optimised over matches.
    """

    rotation: Rotation
    translation: Vector
    score: float
    probability: Float[Array, "match"]
    distance: float = math.nan
    is_proposed: bool = False

    @property
    def motion(self) -> Float[Array, "4 4"]:
        """From the first camera's frame to the second one's, camera heights."""
        return make_motion(self.rotation, self.distance * self.translation)


def _match_noise(first: Features, second: Features, indices: Int[Array, "match 2"]) -> Float[Array, "match"]:
    """Standard deviation of each right match's epipolar angle, radians."""
    return np.maximum(first.noise[indices[:, 0]], second.noise[indices[:, 1]])


def _density(angle: Array, noise: float | Array) -> Array:
    """Probability density of a right match's epipolar angle in [0, pi/2], 1/radian."""
    narrow = np.exp(-0.5 * (angle / noise) ** 2) / noise
    wide = np.exp(-0.5 * (angle / (_WIDE * noise)) ** 2) / (_WIDE * noise)
    return math.sqrt(2 / math.pi) * ((1 - _WIDE_SHARE) * narrow + _WIDE_SHARE * wide)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """All that is known of a relative pose before it is sought.

    Attributes:
        a, b: bearings of the matches in the first and in the second panorama, the most distinctive match first.
        prior: probability of each match to be right.
        noise: standard deviation of a right match's epipolar angle, radians.
        axes: gravity and walls of both panoramas.
        depths: estimated at the matches, if they are known.
        surroundings: all that both panoramas show, with estimated depths.
        links: directions of each panorama towards the other one, as a tour's links state them.
    """

    a: Float[Array, "match 3"]
    b: Float[Array, "match 3"]
    prior: Float[Array, "match"]
    noise: Float[Array, "match"]
    axes: RotationPrior
    depths: MatchDepths | None = None
    surroundings: tuple[Surroundings, Surroundings] | None = None
    links: LinkDirections = NO_LINKS

    def with_noise(self, factor: float) -> _Evidence:
        """The evidence with another noise, in units of this one."""
        return replace(self, noise=factor * self.noise)

    def evaluate(self, rotation: Rotation, translation: Vector, distance: float | None = None) -> Hypothesis:
        """The evidence for a relative pose. Matches whose rays meet behind a camera are counted as wrong.

        The distance of the cameras is that of the matches' depths, unless it is given, as that of a proposal.

        A right match by chance also has its point in front of both cameras in about half of all cases, so that a point
        in front has twice the likelihood ratio against chance (uniform on the sphere).
        """
        every = np.abs(epipolar_angles(self.a, self.b, rotation, translation))
        near = np.flatnonzero(every < _MAX_ANGLE * _WIDE * self.noise)  # few for a wrong pose
        angle, a, b, prior, noise = (each[near] for each in (every, self.a, self.b, self.prior, self.noise))
        points = two_view_depths(a, b, rotation, translation)
        parallax = angle_between(a @ rotation.T, b)
        ratio = np.where(_are_behind(points, parallax, noise), 0.0, 2 * _density(angle, noise))
        is_proposed = distance is not None
        if self.depths is not None:
            depths = self.depths.select(near)
            weight = np.where((points > 0).all(axis=1), prior * ratio / (1 - prior + prior * ratio), 0.0)
            distance = depths.find_distance(points, weight) if distance is None else distance
            if math.isfinite(distance):
                ratio = ratio * depths.likelihood_ratio(points, distance, parallax, noise)
        total = 1 - prior + prior * ratio
        score = float(np.log1p(-self.prior).sum() + np.log(total / (1 - prior)).sum()) + self.axes.score(rotation)
        found = np.zeros(len(every))
        found[near] = prior * ratio / total
        return Hypothesis(rotation, translation, score, found, math.nan if distance is None else distance, is_proposed)

    def refine(self, start: Hypothesis, steps: int) -> Hypothesis:
        """The pose of the smallest weighted epipolar angles near a hypothesis, by Gauss-Newton with a robust loss."""
        rotation, translation, best = start.rotation, start.translation, start
        for _ in range(steps):
            normal, gradient = _normal_equations(self.a, self.b, best.probability, rotation, translation, self.noise)
            rotation, translation, step = _gauss_newton(normal, gradient, rotation, translation, self.axes)
            if not np.abs(step).max() < 0.5:
                break
            found = self.evaluate(rotation, translation)
            before, best = best.score, max(best, found, key=lambda hypothesis: hypothesis.score)
            if best.score <= before + 1e-3:
                break
        return best


def _are_behind(points: Float[Array, "match 2"], parallax: Float[Array, "match"], noise: Array) -> Bool[Array, "match"]:
    """Whether the rays of each match meet behind a camera, by `two_view_depths`; parallel rays do not."""
    return (points < 0).any(axis=1) & (parallax > 3 * noise)


def _gauss_newton(
    hessian: Float[Array, "5 5"],
    gradient: Float[Array, "5"],
    rotation: Rotation,
    translation: Vector,
    axes: RotationPrior,
) -> tuple[Rotation, Vector, Float[Array, "5"]]:
    """The pose after one step, and the step; it is NaN if the matches do not determine the pose.

    The prior of the axes is added to the Hessian and the gradient.
    """
    prior_term = axes.residual(rotation)
    if prior_term is not None:
        residual, jacobian = prior_term
        hessian[:3, :3] += jacobian.T @ jacobian
        gradient[:3] += jacobian.T @ residual
    try:
        step = np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(5), -gradient)
    except np.linalg.LinAlgError:
        step = np.full(5, np.nan)
    translation = translation + _tangent_basis(translation) @ step[3:]
    return rotation_exp(step[:3]) @ rotation, translation / np.linalg.norm(translation), step


def _tangent_basis(direction: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Two orthonormal vectors perpendicular to a unit vector."""
    helper = np.eye(3)[np.abs(direction).argmin()]
    first = cross(direction, helper)
    first /= np.linalg.norm(first)
    return np.stack((first, cross(direction, first)), axis=1)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Epipolar angles of matches, radians, with their derivatives.

    Attributes:
        by_pose: derivatives by the rotation vector (3) and the direction (2) of the pose.
        by_first, by_second: derivatives by the bearings of the first and of the second panorama.
    """

    angle: Float[Array, "n"]
    by_pose: Float[Array, "n 5"]
    by_first: Float[Array, "n 3"]
    by_second: Float[Array, "n 3"]


def _linearise(a: Bearings, b: Bearings, rotation: Rotation, translation: Vector) -> _Linearised:
    g = a @ rotation.T
    by_b, by_g = cross(translation, g), cross(b, translation)
    e = (by_b * b).sum(axis=1, keepdims=True)
    squared = ((by_b - e * b) ** 2).sum(axis=1) + ((by_g - e * g) ** 2).sum(axis=1)
    scale = np.sqrt(np.maximum(squared, 1e-12))[:, None]
    by_pose = np.concatenate((cross(g, by_g), cross(g, b) @ _tangent_basis(translation)), axis=1)
    return _Linearised((e / scale)[:, 0], by_pose / scale, by_g @ rotation / scale, by_b / scale)


def _normal_equations(
    a: Array, b: Array, probability: Array, rotation: Array, translation: Array, noise: float | Array
) -> tuple[Float[Array, "5 5"], Float[Array, "5"]]:
    """Hessian and gradient of the squared angles in the noise's unit, by rotation (3) and direction (2)."""
    used = np.flatnonzero(probability > 0)
    a, b, probability, noise = a[used], b[used], probability[used], np.broadcast_to(noise, len(a))[used]
    linear = _linearise(a, b, rotation, translation)
    jacobian = linear.by_pose / noise[:, None]
    angle = np.abs(linear.angle)
    # Weight of the wide component of the noise is smaller, as in an EM step for a mixture of two Gaussians.
    narrow = (1 - _WIDE_SHARE) * np.exp(-0.5 * (angle / noise) ** 2)
    wide = _WIDE_SHARE / _WIDE * np.exp(-0.5 * (angle / (_WIDE * noise)) ** 2) + 1e-300
    weight = probability * (narrow + wide / _WIDE**2) / (narrow + wide)
    residual = linear.angle / noise
    return (jacobian * weight[:, None]).T @ jacobian, jacobian.T @ (weight * residual)


def polish_pose(
    a: Bearings,
    b: Bearings,
    rotation: Rotation,
    translation: Vector,
    noise: float | Float[Array, "match"],
    axes: RotationPrior = NO_PRIOR,
    weigh: Callable[[Array, Array], Array] | None = None,
    steps: int = 10,
) -> tuple[Rotation, Vector, tuple[float, float]]:
    """The pose by generalised least squares over right matches, and the standard deviations of rotation and direction.

    Stitching distorts a panorama smoothly: matches on one object share an error, which their number does not reduce.
    The covariance of the residuals has this distortion as a random field on each sphere, beside the independent error
    of each match, whose heavy tails reduce the weight of a match with a large residual.

    Args:
        noise: standard deviations of the epipolar angles, radians.
        weigh: the probability of each match to be right under a pose; None if all are.
    """
    start, noise = (rotation, translation), np.broadcast_to(noise, len(a))
    hessian = np.eye(5)
    for _ in range(steps):
        probability = np.ones(len(a)) if weigh is None else weigh(rotation, translation)
        count = min(int((probability > _MIN_PROBABILITY).sum()), _MAX_POLISHED)
        used = np.argsort(-probability, kind="stable")[:count]
        if count < 5:
            return *start, (math.inf, math.inf)
        linear = _linearise(a[used], b[used], rotation, translation)
        covariance = np.diag((noise[used] ** 2 + linear.angle**2 / _TAIL) / probability[used])
        for x, d in ((a[used], linear.by_first), (b[used], linear.by_second)):
            covariance += _DISTORTION**2 * (d @ d.T) * np.exp((x @ x.T - 1) / _DISTORTION_LENGTH**2)
        right = np.concatenate((linear.by_pose, linear.angle[:, None]), axis=1)
        solved = linear.by_pose.T @ np.linalg.solve(covariance, right)
        hessian, gradient = solved[:, :5].copy(), solved[:, 5].copy()
        rotation, translation, step = _gauss_newton(hessian, gradient, rotation, translation, axes)
        if not np.abs(step).max() < 0.2:  # too few matches determine it
            return *start, _deviations(hessian)
        if np.abs(step).max() < 1e-6:
            break
    return rotation, translation, _deviations(hessian)


def _deviations(hessian: Float[Array, "5 5"]) -> tuple[float, float]:
    """Formal standard deviations of rotation and direction, radians."""
    values, vectors = np.linalg.eigh(hessian)
    variance = (vectors**2 / np.maximum(values, 1e-12)).sum(axis=1)
    return math.sqrt(variance[:3].sum()), math.sqrt(variance[3:].sum())


def _calibrate(deviations: tuple[float, float], places: float) -> tuple[float, float]:
    """The standard deviations for which errors on real panoramas have a root mean square of 1."""
    factor = max(_CALIBRATION[0], _CALIBRATION[1] / max(places, 1.0))
    return factor * deviations[0], factor * deviations[1]


def _search_hypotheses(evidence: _Evidence, rng: np.random.Generator) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """Distinct hypotheses that are optimised over the matches, best first, and those of a comparison as proposed."""
    if len(evidence.a) < _MIN_MATCHES:
        return [], []
    chosen = _choose_best(_sample_essentials(evidence, rng), evidence, _KEPT)
    found = [_optimise(essential, evidence, _FACTORS) for essential in chosen]
    if evidence.axes.has_walls:  # inexact: compared among themselves, with a larger tolerance
        chosen = _choose_best(_sample_parallel(evidence, rng), evidence.with_noise(2), _KEPT_PARALLEL)
        found += [_optimise(essential, evidence, _PARALLEL_FACTORS) for essential in chosen]
    proposed = []
    if evidence.depths is not None and evidence.surroundings is not None:
        matches = evidence.a, evidence.b, evidence.prior, evidence.depths
        for rotation, translation in propose_by_depth(*matches, evidence.axes, evidence.surroundings, evidence.links):
            distance = float(np.linalg.norm(translation))
            unit = translation / max(distance, 1e-9)
            found.append(_optimise(skew(unit) @ rotation, evidence, _DEPTH_FACTORS))
            proposed.append(evidence.evaluate(rotation, unit, distance))
    return _merge_same(found), proposed


def _sample_essentials(evidence: _Evidence, rng: np.random.Generator) -> Float[Array, "n 3 3"]:
    """Essential matrices of random samples of levelled cameras, and of cameras in any pose if gravity is unknown."""
    a, b, axes = evidence.a, evidence.b, evidence.axes
    levels = axes.first.axes[_LEVEL], axes.second.axes[_LEVEL]
    found = []
    for top in sorted({min(top, len(a)) for top in _TOP_SETS}):
        chosen = _draw(rng, top, _SAMPLES[3], 3)
        rotations, translations = upright_from_three(a[chosen] @ levels[0].T, b[chosen] @ levels[1].T)
        found.append(levels[1].T @ skew(translations) @ rotations @ levels[0])
        if not axes.has_down:
            chosen = _draw(rng, top, _SAMPLES[5], 5)
            found.append(essential_from_five(a[chosen], b[chosen])[0])
    return np.concatenate(found)


def _sample_parallel(evidence: _Evidence, rng: np.random.Generator) -> Float[Array, "n 3 3"]:
    """Essential matrices of random samples of cameras with parallel walls."""
    a, b, found = evidence.a, evidence.b, []
    for top in sorted({min(top, len(a)) for top in _TOP_SETS}):
        for rotation in evidence.axes.wall_rotations:
            chosen = _draw(rng, top, _SAMPLES[2], 2)
            normals = cross(a[chosen] @ rotation.T, b[chosen])
            translations = cross(normals[:, 0], normals[:, 1])
            translations /= np.maximum(np.linalg.norm(translations, axis=1, keepdims=True), 1e-12)
            found.append(skew(translations) @ rotation)
    return np.concatenate(found)


def _choose_best(essential: Float[Array, "n 3 3"], evidence: _Evidence, count: int) -> Float[Array, "kept 3 3"]:
    """At most `count` different essential matrices with the highest scores, best first."""
    quick = _score_essentials(essential, evidence, _QUICK)
    essential = essential[np.argsort(-quick, kind="stable")[:_RESCORED]]
    return essential[_pick_distinct(essential, _score_essentials(essential, evidence), count)]


def _sample_depths(
    surroundings: tuple[Surroundings, Surroundings] | None, a: Bearings, b: Bearings
) -> MatchDepths | None:
    if surroundings is None:
        return None
    (first, first_deviation), (second, second_deviation) = (
        view.depth.sample(rays) for view, rays in zip(surroundings, (a, b), strict=True)
    )
    return MatchDepths(np.stack((first, second), axis=1), np.stack((first_deviation, second_deviation), axis=1))


def _optimise(essential: Float[Array, "3 3"], evidence: _Evidence, factors: Sequence[float]) -> Hypothesis:
    """The best pose of an essential matrix, refined with decreasing factors of the noise."""
    start = evidence.with_noise(factors[0])
    options = [start.evaluate(rotation, translation) for rotation, translation in decompose_essential(essential)]
    best = max(options, key=lambda option: option.score)
    for factor in factors:
        relaxed = evidence.with_noise(factor)
        best = relaxed.refine(relaxed.evaluate(best.rotation, best.translation), steps=4 if factor > 1 else 6)
    return best


def _merge_same(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypothesis of the highest score of each group of equal ones, best first."""
    distinct: list[Hypothesis] = []
    for hypothesis in sorted(found, key=lambda h: -h.score):
        if not any(_are_same(hypothesis, other) for other in distinct):
            distinct.append(hypothesis)
    return distinct


def _are_same(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two hypotheses hardly differ."""
    turned = rotation_angle(first.rotation @ second.rotation.T)
    return bool(turned < _SAME_ROTATION and angle_between(first.translation, second.translation) < _SAME_DIRECTION)


def _draw(rng: np.random.Generator, top: int, samples: int, size: int) -> Int[Array, "samples size"]:
    """Samples of different numbers below `top`."""
    chosen = np.sort(rng.integers(0, top - size + 1, (samples, size)), axis=1)
    return chosen + np.arange(size)


def _score_essentials(
    essential: Float[Array, "n 3 3"], evidence: _Evidence, count: int | None = None
) -> Float[Array, "n"]:
    """Scores of essential matrices without the signs of the depths, by the first `count` matches."""
    a, b = (np.ascontiguousarray(rays[:count].T, np.float32) for rays in (evidence.a, evidence.b))
    prior, noise = evidence.prior[:count], evidence.noise[:count]
    gain = math.sqrt(2 / math.pi) * prior / (1 - prior) / noise
    scores = _sum_gains(essential.astype(np.float32), a, b, noise.astype(np.float32), gain)
    return scores + float(np.log1p(-prior).sum())


@compiled
def _sum_gains(essentials, a, b, noise, gain):
    """Sums of log(1 + gain * density) over matches near their epipolar curves; bearings are columns, in float32.

    Squared Sampson denominators are |E a|^2 + |E' b|^2, up to the square of the residual.
    """
    scores, squared = np.empty(len(essentials)), np.empty(len(noise), np.float32)
    limit, tiny = np.float32((_MAX_ANGLE * _WIDE) ** 2), np.float32(1e-12)
    ax, ay, az, bx, by, bz = a[0], a[1], a[2], b[0], b[1], b[2]
    for n in range(len(essentials)):
        e = essentials[n]
        e00, e01, e02, e10, e11 = e[0, 0], e[0, 1], e[0, 2], e[1, 0], e[1, 1]
        e12, e20, e21, e22 = e[1, 2], e[2, 0], e[2, 1], e[2, 2]
        for i in range(len(noise)):
            x = e00 * ax[i] + e01 * ay[i] + e02 * az[i]
            y = e10 * ax[i] + e11 * ay[i] + e12 * az[i]
            z = e20 * ax[i] + e21 * ay[i] + e22 * az[i]
            u = e00 * bx[i] + e10 * by[i] + e20 * bz[i]
            v = e01 * bx[i] + e11 * by[i] + e21 * bz[i]
            w = e02 * bx[i] + e12 * by[i] + e22 * bz[i]
            residual = x * bx[i] + y * by[i] + z * bz[i]
            scale = max(x * x + y * y + z * z + u * u + v * v + w * w, tiny)
            squared[i] = residual * residual / (scale * (noise[i] * noise[i]))
        scores[n] = 0
        for i in range(len(noise)):
            if squared[i] < limit:
                root = math.exp(-0.5 / _WIDE**2 * squared[i])
                scores[n] += math.log1p(gain[i] * ((1 - _WIDE_SHARE) * root**9 + _WIDE_SHARE / _WIDE * root))
    return scores


def _pick_distinct(essential: Float[Array, "n 3 3"], scores: Float[Array, "n"], kept: int) -> list[int]:
    """Indices of the best hypotheses whose essential matrices differ."""
    picked: list[int] = []
    norm = np.linalg.norm(essential, axis=(1, 2))
    for index in np.argsort(-scores, kind="stable")[:_COMPARED_ESSENTIALS]:
        if len(picked) == kept:
            break
        similarity = [abs((essential[index] * essential[p]).sum()) / (norm[index] * norm[p]) for p in picked]
        if not similarity or max(similarity) < _SAME_ESSENTIAL:
            picked.append(int(index))
    return picked


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Relative poses of two panoramas, of which at most one is right: a row for each compared `Hypothesis`.

    Attributes:
        motions: motions from the first camera's frame to the second one's, camera heights.
        log_odds: logarithm of the odds of each against none.
    """

    motions: Float[Array, "n 4 4"] = field(default_factory=lambda: np.empty((0, 4, 4)))
    log_odds: Float[Array, "n"] = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose of two panoramas, and the figures of its check.

    Attributes:
        rotation, translation: x2 = R x1 + t; |t| = 1.
        indices: features of the matches that agree with it; none if it is that of a comparison.
        score: natural logarithm of the likelihood ratio against chance.
        places: number of different places (12 degrees) with right matches, in the panorama that has fewer.
        parallax: 90 % quantile of the parallax of these matches, radians.
        uncertainty: standard deviations of rotation and direction by the noise of the matches, the distortion of the
            panoramas and the number of places, radians.
        distance: camera heights between the cameras, by the estimated depths; NaN if they do not state it.
        log_odds: logarithm of the odds that the pose is right, by matches and comparison; infinite if matches suffice.
        problem: why the pose must not be used; None if it passes the check.
        hypotheses: all that were compared, this pose among them.
    """

    rotation: Rotation
    translation: Vector
    indices: Int[Array, "match 2"]
    score: float = 0.0
    places: float = 0.0
    parallax: float = 0.0
    uncertainty: tuple[float, float] = (math.inf, math.inf)
    distance: float = math.nan
    log_odds: float = -math.inf
    problem: str | None = None
    hypotheses: Hypotheses = Hypotheses()

    @property
    def motion(self) -> Float[Array, "4 4"]:
        """From the first camera's frame to the second one's, camera heights."""
        return make_motion(self.rotation, self.distance * self.translation)

    @property
    def is_matched(self) -> bool:
        """Whether matches determine the pose."""
        return len(self.indices) > 0

    @property
    def is_reliable(self) -> bool:
        """Whether the pose passes the check."""
        return self.problem is None

    @property
    def is_doubtful(self) -> bool:
        """Whether too little is known by itself, and further pairs may confirm it."""
        return not self.is_reliable and _DOUBTFUL_ODDS <= self.log_odds < _PROBABLE_ODDS

    @property
    def is_certain(self) -> bool:
        """Whether its odds are above 7 to 1, or its matches suffice; else it is probable."""
        return self.is_reliable and self.log_odds >= _CERTAIN_ODDS


def estimate_relative_pose(
    first: Features,
    second: Features,
    matches: Matches,
    axes: RotationPrior = NO_PRIOR,
    surroundings: tuple[Surroundings, Surroundings] | None = None,
    links: LinkDirections = NO_LINKS,
    *,
    seed: int = 0,
) -> RelativePose:
    """The most probable relative pose of two panoramas, with its check.

    Args:
        first, second: features of both panoramas.
        matches: matches of these features.
        axes: gravity and walls of both panoramas.
        surroundings: all that both panoramas show, with estimated depths; without them only the matches count.
        links: directions of each panorama towards the other one.
        seed: seed of the random samples.
    """
    count = min(len(matches), _MAX_MATCHES)
    indices = matches.indices[:count]
    a, b = first.bearings[indices[:, 0]], second.bearings[indices[:, 1]]
    noise, depths = _match_noise(first, second, indices), _sample_depths(surroundings, a, b)
    evidence = _Evidence(a, b, matches.prior[:count], noise, axes, depths, surroundings, links)
    found, proposed = _search_hypotheses(evidence, np.random.default_rng(seed))
    if not found:
        no_match = f"only {count} features match"
        return RelativePose(np.eye(3), np.array((0.0, 0, 1)), indices[:0], problem=no_match)
    compared = [*found[:_COMPARED], *proposed]
    odds = np.array([_log_odds(h, evidence) for h in compared])
    best, log_odds = _choose_compared(compared, odds)
    # Matches that suffice decide alone: the odds also use estimated depths, which are wrong for a camera on stairs.
    if _suffice(found, evidence):
        best, log_odds = found[0], math.inf
    places = _count_all_places(best, evidence)
    relation = RelativePose(
        best.rotation,
        best.translation,
        indices[:0],
        score=best.score,
        places=places,
        distance=best.distance,
        log_odds=log_odds,
        problem=None if log_odds >= _PROBABLE_ODDS else _describe_doubt(places, log_odds),
        hypotheses=Hypotheses(np.stack([h.motion for h in compared]), odds),
    )
    if best.is_proposed:
        return replace(relation, uncertainty=(_PROPOSAL_NOISE[0], math.atan(_PROPOSAL_NOISE[1] / best.distance)))
    right = best.probability > 0.5
    parallax = angle_between(a @ best.rotation.T, b)[right]
    spread = float(np.quantile(parallax, 0.9)) if len(parallax) else 0.0
    relation = replace(relation, indices=indices[right], parallax=spread)
    if spread < _MIN_PARALLAX * np.median(evidence.noise) and right.sum() >= _MIN_MATCHES:
        problem = f"both were taken at one place: parallax of {math.degrees(spread):.2f} degrees"
        return replace(relation, problem=problem, hypotheses=Hypotheses())
    if log_odds < _DOUBTFUL_ODDS:
        return relation
    used = np.flatnonzero(right)[:_MAX_POLISHED]
    rotation, translation, deviations = polish_pose(
        a[used], b[used], best.rotation, best.translation, evidence.noise[used], axes
    )
    uncertainty = _calibrate(deviations, places)
    relation = replace(relation, rotation=rotation, translation=translation, uncertainty=uncertainty)
    if relation.is_reliable and surroundings is not None and not math.isfinite(best.distance):
        return replace(relation, problem="the distance of the cameras cannot be determined")
    if relation.is_reliable and uncertainty[1] > _MAX_UNCERTAINTY:
        return replace(relation, problem=f"the direction is uncertain by {math.degrees(uncertainty[1]):.0f} degrees")
    return relation


def _choose_compared(compared: Sequence[Hypothesis], odds: Float[Array, "n"]) -> tuple[Hypothesis, float]:
    """The most probable hypothesis and the logarithm of its odds: at most one of different hypotheses is right."""
    best = compared[int(odds.argmax())]
    same = np.array([_are_near(best, other) for other in compared])
    log_odds = float(np.logaddexp.reduce(odds[same]) - np.logaddexp.reduce(np.append(odds[~same], 0.0)))
    likely = np.flatnonzero(same & (odds > odds.max() - _PREFERENCE))
    matched = [n for n in likely if not compared[n].is_proposed]
    return compared[max(matched, key=lambda n: odds[n])] if matched else best, log_odds


def _are_near(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two hypotheses state one pose, by the distance of the cameras, too."""
    gap = float(np.linalg.norm(first.motion[:3, 3] - second.motion[:3, 3]))
    longest = max(first.distance, second.distance)
    turned = rotation_angle(first.rotation @ second.rotation.T)
    return first is second or bool(turned < _NEAR[0] and gap < max(_NEAR[1], _NEAR[2] * longest))


def _log_odds(hypothesis: Hypothesis, evidence: _Evidence) -> float:
    """Logarithm of the odds of a hypothesis against none; -inf if the panoramas cannot be compared."""
    if evidence.surroundings is None or not math.isfinite(hypothesis.distance):
        return -math.inf
    translation = hypothesis.motion[:3, 3]
    comparison = compare(*evidence.surroundings, hypothesis.rotation, translation)
    slope = abs(float(hypothesis.translation @ (hypothesis.rotation @ evidence.axes.first.axes[0])))
    values = (
        1.0,
        math.log1p(max(hypothesis.score, 0.0)),
        math.log1p(_count_all_places(hypothesis, evidence)),
        float(evidence.axes.confirms(hypothesis.rotation)),
        math.log(_LEAST_CONFLICT + comparison.conflict),
        comparison.likeness * comparison.weight,
        comparison.shade * comparison.weight,
        comparison.hue * comparison.weight,
        comparison.overlap,
        math.log(_LEAST_SLOPE + min(slope, _LARGEST_SLOPE)),
        float(hypothesis.is_proposed),
    )
    return float(np.dot(_ODDS, values) + evidence.links.score(hypothesis.rotation[None], translation[None])[0])


def _count_all_places(hypothesis: Hypothesis, evidence: _Evidence) -> float:
    return min(_count_places(rays, hypothesis.probability) for rays in (evidence.a, evidence.b))


def _suffice(found: Sequence[Hypothesis], evidence: _Evidence) -> bool:
    """Whether the matches alone support the first hypothesis, which has the highest score."""
    best, margin = found[0], found[0].score - (found[1].score if len(found) > 1 else 0.0)
    is_clear = best.score >= _NEEDED_SCORE and margin >= _NEEDED_MARGIN
    return is_clear and _count_all_places(best, evidence) >= _NEEDED_PLACES


def _describe_doubt(places: float, log_odds: float) -> str:
    """Why a pose must not be used whose matches do not suffice, also with the comparison of both panoramas."""
    outcome = "too uncertain to use"
    if log_odds > _SHOWN_ODDS:
        probability, needed = (100 / (1 + math.exp(-odds)) for odds in (log_odds, _PROBABLE_ODDS))
        outcome = f"right with a probability of {probability:.0f} %, and {needed:.0f} % are needed"
    return (
        f"too little in common: {places:.0f} places match where {_NEEDED_PLACES:g} suffice, and the best pose is "
        f"{outcome}"
    )


def polish_relative_pose(
    relation: RelativePose, first: Features, second: Features, matches: Matches, axes: RotationPrior = NO_PRIOR
) -> RelativePose:
    """The pose by all matches near their epipolar curves, which may include those of further features.

    Wrong matches are not uniformly distributed: features of floor and ceiling match such features, so that several
    times as many wrong matches as by chance lie near the curves of level cameras. Their density, and the share of
    right matches for each ratio, are therefore measured on the pair, by expectation and maximisation.
    """
    rotation, translation = relation.rotation, relation.translation
    every = first.bearings[matches.indices[:, 0]], second.bearings[matches.indices[:, 1]]
    near = np.abs(epipolar_angles(*every, rotation, translation)) < 2 * _POLISH_WINDOW
    a, b, indices = every[0][near], every[1][near], matches.indices[near]
    sizes = np.maximum(first.sizes[indices[:, 0]], second.sizes[indices[:, 1]])
    noise = _match_noise(first, second, indices) * np.hypot(1, sizes / _POLISH_SIZE)
    weigh = _LocalWeights(a, b, np.searchsorted(-_POLISH_PRIORS, -matches.prior[near], side="right"), noise)
    for factor in _POLISH_FACTORS:
        for _ in range(_POLISH_STEPS):
            probability = weigh(rotation, translation, factor)
            if (probability > _MIN_PROBABILITY).sum() < _MIN_POLISHED:
                return relation
            equations = _normal_equations(a, b, probability, rotation, translation, factor * noise)
            rotation, translation, step = _gauss_newton(*equations, rotation, translation, axes)
            if not np.abs(step).max() < 0.2:
                return relation
    rotation, translation, uncertainty = polish_pose(a, b, rotation, translation, noise, axes, weigh)
    # A tour has a robust loss, and needs as many points as possible that several panoramas see.
    evidence = _Evidence(*every, matches.prior, _match_noise(first, second, matches.indices), axes)
    agreeing = evidence.evaluate(rotation, translation)
    return replace(
        relation,
        rotation=rotation,
        translation=translation,
        indices=matches.indices[agreeing.probability > 0.5],
        uncertainty=_calibrate(uncertainty, relation.places),
    )


class _LocalWeights:
    """Probabilities of matches near their epipolar curves to be right, with shares that improve with each call."""

    def __init__(self, a: Array, b: Array, group: Int[Array, "match"], noise: Float[Array, "match"]) -> None:
        self.a, self.b, self.group, self.noise = a, b, group, noise
        self.shares = _POLISH_SHARES

    def __call__(self, rotation: Array, translation: Array, factor: float = 1.0) -> Float[Array, "match"]:
        """The probabilities under a pose, with `factor` times the noise."""
        noise = factor * self.noise
        angle = np.abs(epipolar_angles(self.a, self.b, rotation, translation))
        points = two_view_depths(self.a, self.b, rotation, translation)
        behind = _are_behind(points, angle_between(self.a @ rotation.T, self.b), noise)
        inside = ~behind & (angle < _POLISH_WINDOW)
        ratio = _density(angle, noise) * _POLISH_WINDOW
        count = np.bincount(self.group[inside], minlength=len(self.shares))
        probability = np.zeros(len(angle))
        for _ in range(_SHARE_STEPS):
            share = self.shares[self.group]
            probability = np.where(inside, share * ratio / (share * ratio + 1 - share), 0.0)
            right = np.bincount(self.group[inside], probability[inside], len(self.shares))
            self.shares = (right + _POLISH_WEIGHT * _POLISH_SHARES) / (count + _POLISH_WEIGHT)
        return probability


def _count_places(bearings: Float[Array, "n 3"], probability: Float[Array, "n"]) -> float:
    """Sum over the cells of the sphere of the largest probability in each. Matches on one object count little."""
    _, cell = np.unique(np.rint(bearings / _PLACE).astype(np.int64), axis=0, return_inverse=True)
    highest = np.zeros(int(cell.max()) + 1)
    np.maximum.at(highest, cell.reshape(-1), probability)
    return float(highest.sum())
