"""Relative poses from few pairs of bearings, for many samples at once, and the geometry of two views on the sphere.

A relative pose (R, t) maps points of the first camera to the second one: x2 = R x1 + t. Bearings are unit vectors of
the whole sphere. Two bearings a and b of one point fulfil b . (t x R a) = 0, or b' E a = 0 with the essential matrix
E = [t]x R.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int
from numpy import ndarray as Array

from pansplat.system.kernels import cached_njit

compiled: Any = cached_njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
"""Compile a function of numpy arrays."""
Bearings = Float[Array, "n 3"]
Rotation = Float[Array, "3 3"]
Vector = Float[Array, "3"]

_ROOT_SAMPLES = 72  # angles at which a trigonometric polynomial is evaluated to find its sign changes
_MIN_SINE = 1e-12

# Monomials of degree 3 in x, y, z, 1 in the order of elimination: those that are solved for, then the basis.
_DEGREES = (
    (3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 1, 1), (1, 0, 2), (0, 3, 0), (0, 2, 1), (0, 1, 2), (0, 0, 3),
    (2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0),
)  # fmt: skip


def _monomial(factors: tuple[int, ...]) -> int:
    """Index of the product of unknowns; 0, 1, 2 are x, y, z and 3 is the constant 1."""
    return _DEGREES.index((factors.count(0), factors.count(1), factors.count(2)))


_CUBIC = np.zeros((64, 20))
for _n, _factors in enumerate(itertools.product(range(4), repeat=3)):
    _CUBIC[_n, _monomial(_factors)] = 1
_MULTIPLIED_BY_X = [
    _monomial((0, *((0,) * d[0] + (1,) * d[1] + (2,) * d[2] + (3,) * (2 - sum(d))))) for d in _DEGREES[10:]
]


def cross(a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]) -> Float[Array, "*batch 3"]:
    """The cross product along the last axis, without the transpositions of `np.cross`."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def skew(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Matrices of the cross product from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=-1).reshape(*vectors.shape[:-1], 3, 3)


def make_motion(
    rotation: Float[Array, "*batch 3 3"], translation: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 4 4"]:
    """Matrices of rigid motions x2 = R x1 + t."""
    motion = np.zeros((*rotation.shape[:-2], 4, 4))
    motion[..., :3, :3], motion[..., :3, 3], motion[..., 3, 3] = rotation, translation, 1
    return motion


def rotation_exp(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of one or several rotation vectors, radians."""
    return scipy.spatial.transform.Rotation.from_rotvec(vectors).as_matrix()


def rotation_angle(rotation: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Angle of rotations, radians; exact for small ones."""
    twice = rotation - np.swapaxes(rotation, -1, -2)  # the axis times twice the sine, as a cross product
    axis = np.stack((twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]), axis=-1)
    sine = 0.5 * np.linalg.norm(axis, axis=-1)
    return np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1))


def angle_between(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Angle between vectors, radians; exact for small and large angles."""
    return np.arctan2(np.linalg.norm(cross(a, b), axis=-1), (a * b).sum(axis=-1))


def essential_from_five(
    a: Float[Array, "sample 5 3"], b: Float[Array, "sample 5 3"]
) -> tuple[Float[Array, "solution 3 3"], Int[Array, "solution"]]:
    """Essential matrices of five pairs of bearings each, and the sample of each solution.

    Source: H. Stewenius, C. Engels, D. Nister, Recent developments on direct relative orientation, ISPRS 2006.
    """
    equations = (b[:, :, :, None] * a[:, :, None, :]).reshape(len(a), 5, 9)
    basis = np.linalg.svd(equations)[2][:, 5:].reshape(-1, 4, 3, 3)  # E = x E0 + y E1 + z E2 + E3
    # E E' E - trace(E E') E / 2 = 0 and det E = 0, as cubic polynomials: coefficients by the three factors.
    product = np.einsum("spij,sqkj->spqik", basis, basis)
    triple = np.einsum("spqik,srkj->spqrij", product, basis)
    trace = np.einsum("spqii->spq", product)
    cubic = triple - 0.5 * trace[..., None, None, None] * basis[:, None, None]
    determinant = np.einsum("spi,sqri->spqr", basis[:, :, 0], cross(basis[:, :, None, 1], basis[:, None, :, 2]))
    constraints = np.concatenate((cubic.reshape(-1, 64, 9), determinant.reshape(-1, 64, 1)), axis=2)
    matrix = np.einsum("snc,nm->scm", constraints, _CUBIC)
    with np.errstate(all="ignore"):
        reduced = _solve(matrix[:, :, :10], matrix[:, :, 10:])
        action = np.zeros((len(a), 10, 10))
        for row, target in enumerate(_MULTIPLIED_BY_X):
            if target < 10:
                action[:, row] = -reduced[:, target]
            else:
                action[:, row, target - 10] = 1
        action = np.where(np.isfinite(action).all(axis=(1, 2))[:, None, None], action, 0.0)
        values, vectors = np.linalg.eig(action)
        real = (np.abs(values.imag) < 1e-8 * (1 + np.abs(values.real))) & (np.abs(vectors[:, 9]) > 1e-12)
        sample, index = np.nonzero(real)
        chosen = vectors[sample, :, index].real
        xyz = chosen[:, 6:9] / chosen[:, 9:]
    essential = np.einsum("np,npij->nij", np.concatenate((xyz, np.ones((len(xyz), 1))), axis=1), basis[sample])
    norm = np.linalg.norm(essential, axis=(1, 2))
    usable = np.isfinite(norm) & (norm > 0)
    return essential[usable] / norm[usable][:, None, None], sample[usable]


def _solve(matrix: Float[Array, "sample n n"], right: Float[Array, "sample n m"]) -> Float[Array, "sample n m"]:
    """Solutions of linear systems; NaN where a matrix is singular."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        regular = np.linalg.matrix_rank(matrix) == matrix.shape[-1]
        solved = np.full(right.shape, np.nan)
        solved[regular] = np.linalg.solve(matrix[regular], right[regular])
        return solved


def upright_from_three(
    a: Float[Array, "sample 3 3"], b: Float[Array, "sample 3 3"]
) -> tuple[Float[Array, "solution 3 3"], Float[Array, "solution 3"]]:
    """Relative poses (R, t) of upright cameras (y along gravity) from three pairs of bearings each.

    t is perpendicular to the three vectors R a x b. Their determinant is a trigonometric polynomial of degree 3 in the
    angle of R.
    """
    sample, angle = _trigonometric_roots(lambda yaw: np.linalg.det(_normals(a, b, yaw)))
    normals = _normals(a[sample], b[sample], angle[:, None])[:, 0]
    candidates = cross(normals[:, (0, 1, 2)], normals[:, (1, 2, 0)])
    length = np.linalg.norm(candidates, axis=-1)
    best = length.argmax(axis=1)
    rows = np.arange(len(best))
    usable = length[rows, best] > _MIN_SINE
    translation = candidates[rows, best][usable] / length[rows, best][usable][:, None]
    return _yaw_rotations(angle[usable]), translation


def _yaw_rotations(angle: Float[Array, "*batch"]) -> Float[Array, "*batch 3 3"]:
    zero, one, cos, sin = np.zeros_like(angle), np.ones_like(angle), np.cos(angle), np.sin(angle)
    return np.stack((cos, zero, sin, zero, one, zero, -sin, zero, cos), axis=-1).reshape(*angle.shape, 3, 3)


def _normals(a: Array, b: Array, yaw: Array) -> Float[Array, "sample angle n 3"]:
    """R a x b for each rotation by an angle (sample or 1, angle)."""
    rotated = np.einsum("saij,snj->sani", np.broadcast_to(_yaw_rotations(yaw), (len(a), yaw.shape[1], 3, 3)), a)
    return cross(rotated, b[:, None])


def _trigonometric_roots(function: Callable[[Array], Array]) -> tuple[Int[Array, "root"], Float[Array, "root"]]:
    """Sample and angle of the roots of trigonometric polynomials of degree 3.

    Roots are sign changes on a regular grid, improved by Newton's method; pairs of nearly equal roots are missed.

    Args:
        function: evaluates all polynomials at (1, n) angles.
    """
    degree = 3
    nodes = 2 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
    values = function(nodes[None])  # (count, nodes)
    orders = np.arange(1, degree + 1)

    def terms(angle: Array) -> Array:
        phase = angle[..., None] * orders
        return np.concatenate((np.ones((*angle.shape, 1)), np.cos(phase), np.sin(phase)), axis=-1)

    coefficients = values @ np.linalg.inv(terms(nodes)).T
    grid = 2 * np.pi * np.arange(_ROOT_SAMPLES + 1) / _ROOT_SAMPLES
    dense = coefficients @ terms(grid).T
    sample, left = np.nonzero(dense[:, :-1] * dense[:, 1:] < 0)
    low, high = grid[left], grid[left + 1]
    low_value, high_value = dense[sample, left], dense[sample, left + 1]
    root = low - low_value * (high - low) / (high_value - low_value)
    for _ in range(4):  # Newton's method within the interval
        chosen, values = coefficients[sample], terms(root)
        value = (chosen * values).sum(axis=-1)
        cosine, sine = values[:, 1 : degree + 1], values[:, degree + 1 :]
        derivative = (orders * (chosen[:, degree + 1 :] * cosine - chosen[:, 1 : degree + 1] * sine)).sum(axis=-1)
        root = np.clip(root - value / np.where(derivative == 0, 1.0, derivative), low, high)
    return sample, root


def decompose_essential(essential: Float[Array, "3 3"]) -> list[tuple[Float[Array, "3 3"], Float[Array, "3"]]]:
    """The four relative poses (R, t) of an essential matrix."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    w = np.array(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    return [(u @ m @ vt, sign * u[:, 2]) for m in (w, w.T) for sign in (1.0, -1.0)]


def epipolar_angles(a: Bearings, b: Bearings, rotation: Rotation, translation: Vector) -> Float[Array, "n"]:
    """The signed angle, radians, by which both bearings of a pair must turn in total to meet (first order).

    Its square is the Sampson error on the sphere.
    """
    return _epipolar_angles(*(np.ascontiguousarray(each, np.float64) for each in (a, b, rotation, translation)))


@compiled
def _epipolar_angles(a, b, r, t):
    angles = np.empty(len(a))
    for i in range(len(a)):
        x, y, z, bx, by, bz = a[i, 0], a[i, 1], a[i, 2], b[i, 0], b[i, 1], b[i, 2]
        gx = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
        gy = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
        gz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        px, py, pz = t[1] * gz - t[2] * gy, t[2] * gx - t[0] * gz, t[0] * gy - t[1] * gx
        qx, qy, qz = by * t[2] - bz * t[1], bz * t[0] - bx * t[2], bx * t[1] - by * t[0]
        e = px * bx + py * by + pz * bz
        # Gradients by the two bearings, on their tangent planes: p - e b and q - e g.
        squared = px * px + py * py + pz * pz + qx * qx + qy * qy + qz * qz - 2 * e * e
        angles[i] = e / math.sqrt(max(squared, _MIN_SINE))
    return angles


def two_view_depths(a: Bearings, b: Bearings, rotation: Rotation, translation: Vector) -> Float[Array, "n 2"]:
    """Distances of the points from both cameras, in units of |t|; negative if the rays meet behind a camera.

    Rays are parallel at an infinite distance; the distances are then large numbers of either sign.
    """
    g = a @ rotation.T
    cosine = (g * b).sum(axis=1)
    along_a, along_b = g @ translation, b @ translation
    sine_squared = np.maximum((cross(g, b) ** 2).sum(axis=1), _MIN_SINE)
    first = (cosine * along_b - along_a) / sine_squared
    second = (along_b - cosine * along_a) / sine_squared
    return np.stack((first, second), axis=1)
