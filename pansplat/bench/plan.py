"""Which groups a run measures: quick (some minutes on two cores) or full.

The quick run compares all choices at half the height, and only the main ones at the full height.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.cases import Case, Group, Subject, choices, default_face_size, official
from pansplat.bench.scenes import full_lattice_room, lattice_room_size
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats

DENSE_HEIGHT = 64  # what a renderer without tiles can bear
_BYTES = 600  # a Gaussian: the scene, its gradients, and what drawing takes, generously
_BEARABLE = 4_000_000  # Gaussians that the torch reference draws in minutes
_LARGEST_CHOICE = 512  # pixels: every choice needs a float64 truth of its own
_OURS = ("triton", "numba")


@dataclass(frozen=True)
class Settings:
    """What a run measures.

    Attributes:
        height: of the largest pictures of the comparison, pixels.
        quick: some minutes instead of an hour.
        threads: the most that are used.
        backends: usable ones besides torch.
        memory: bytes that may be used; larger scenes are left out.
    """

    height: int
    quick: bool
    threads: int
    backends: tuple[str, ...]
    memory: float

    @property
    def choice_height(self) -> int:
        """Height of the pictures that compare every choice."""
        return min(_lattice(0.375 * self.height) if self.quick else self.height, _LARGEST_CHOICE)

    @property
    def face_sizes(self) -> tuple[int, ...]:
        """Sides of cube faces: the default; in the full run the original's, too, and one as fine everywhere."""
        height = self.choice_height
        usual = default_face_size(height)
        return (usual,) if self.quick else (height // 2, usual, height)

    @property
    def fast(self) -> list[str]:
        """Our backends that the sweeps are about, fastest first."""
        return [name for name in _OURS if name in self.backends]

    @property
    def with_torch(self) -> bool:
        """Whether the torch reference can draw the full height."""
        return lattice_room_size(self.height) <= _BEARABLE


def room(height: int) -> Subject:
    """The synthetic room, seen from between its cameras, a little off the line.

    The camera is turned so that no wall faces a cube face squarely: all of such a wall would lie at one depth, and
    order "z" would be that of rounding.
    """
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.97, 0.06, 0.21, 0.04), dtype=torch.float64))
    pose[:3, 3] = torch.tensor((0.1, 0.05, 0.15))
    return Subject(f"room {height}", partial(full_lattice_room, _lattice(height)), pose)


def of_scene(name: str, load: Callable[[], Gaussians], pose: Float[Tensor, "4 4"]) -> Callable[[int], Subject]:
    """A scene from elsewhere, the same whatever the height."""
    return lambda height: Subject(name, load, pose)


def groups(settings: Settings, subject: Callable[[int], Subject], *, synthetic: bool) -> list[Group]:
    """All groups of a scene, the most telling first.

    Args:
        subject: the scene for a height.
        synthetic: the room, which exists in every size; other scenes are thinned out for the sweep of counts.
    """
    height, small = settings.height, settings.choice_height
    truths = ("exact" if settings.quick else "own") if settings.with_torch else "none"
    found = [
        _group("headline", subject(height), _headline(settings), truths),
        _group("choices", subject(small), _choices(settings), "own"),
    ]
    if synthetic:
        dense = Case("dense", DENSE_HEIGHT)
        others = [replace(dense, backend=name) for name in ("torch", *settings.backends)]
        found.append(_group("dense", room(DENSE_HEIGHT), [dense, *others], "own"))
    for index, one in enumerate(_counts(settings, subject, synthetic)):
        found.append(_group("count", one, _sweep(settings, height, slow=index == 0 and not settings.quick), "none"))
    for index, one_height in enumerate(_heights(settings)):
        if not synthetic or lattice_room_size(one_height) * _BYTES < settings.memory:
            cases = _sweep(settings, one_height, slow=index < 2)
            found.append(_group("resolution", subject(one_height), cases, "none"))
    return [group for group in found if group.cases]


def sample_groups(settings: Settings, subject: Subject) -> list[Group]:
    """A real scene's main choices, so that what the room shows can be checked on it."""
    small = replace(settings, height=settings.choice_height)
    cases = [case for name in settings.fast for case in _main(small, name)]
    cases += [Case("torch", small.height)] if cases else _main(small, "torch")
    return [_group("scene", subject, cases, "own")]


def _group(suite: str, subject: Subject, cases: list[Case], truths: Literal["own", "exact", "none"]) -> Group:
    return Group(suite, subject, tuple(case for case in cases if case.possible), truths)


def _main(settings: Settings, backend: str) -> list[Case]:
    """The direct panorama, the stitched ones, and the original's choices."""
    height, threads = settings.height, 1 if backend == "torch" else settings.threads
    face_size = default_face_size(height)
    stitched = Case(backend, height, layout="cubemap", face_size=face_size, threads=threads)
    return [
        Case(backend, height, threads=threads),
        stitched,
        replace(stitched, kernel="ewa"),
        official(backend, height, threads),
    ]


def _headline(settings: Settings) -> list[Case]:
    cases = []
    for backend in settings.backends:
        cases += _main(settings, backend)
        if settings.threads > 1:
            cases.append(Case(backend, settings.height))
    return [*cases, Case("torch", settings.height)] if settings.with_torch else cases


def _choices(settings: Settings) -> list[Case]:
    height, cases = settings.choice_height, []
    for backend in settings.backends:
        cases += choices(backend, height, settings.face_sizes, settings.threads)
    if settings.quick:
        return cases + _main(replace(settings, height=height), "torch")
    return cases + [replace(case, backward=False) for case in choices("torch", height, settings.face_sizes, 1)]


def _sweep(settings: Settings, height: int, *, slow: bool) -> list[Case]:
    """The direct panorama by the fast backends, and by torch where that does not take long."""
    fast = [Case(name, height, threads=settings.threads) for name in settings.fast]
    return fast + ([Case("torch", height)] if (slow and settings.with_torch) or not fast else [])


def _counts(settings: Settings, subject: Callable[[int], Subject], synthetic: bool) -> list[Subject]:
    """Scenes of about a sixteenth, an eighth, a quarter, half and all Gaussians."""
    if synthetic:
        return [room(_lattice(settings.height * share)) for share in (0.25, 0.354, 0.5, 0.707, 1.0)]
    whole = subject(settings.height)
    return [
        Subject(f"{whole.name} 1/{part}", partial(_thinned, whole.load, part), whole.pose) for part in (16, 8, 4, 2, 1)
    ]


def _thinned(load: Callable[[], Gaussians], part: int) -> Gaussians:
    gaussians = load()
    return gaussians.select(torch.arange(0, len(gaussians), part))


def _heights(settings: Settings) -> list[int]:
    shares = (0.25, 0.5, 1, 2) if settings.quick else (0.25, 0.5, 1, 2, 4)
    return [_lattice(settings.height * share) for share in shares]


def _lattice(height: float) -> int:
    """The nearest height that halves three times."""
    return max(8, 8 * round(height / 8))
