"""The contract of all backends: image and gradients equal those of the dense float64 renderer, in each hard case.

The tolerances are those of `BACKENDS` in dense_renderer.py; a case that is worse conditioned states by which factor.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from dense_renderer import NO_QUATS, POSE, Renderer, assert_dense, make_scene, make_spheres
from torch import Tensor

from pansplat.gaussians.scene import Gaussians

Case = tuple[Gaussians, dict[str, Any]]
PINHOLE: dict[str, Any] = {"layout": "pinhole"}
LIGHT: dict[str, Any] = {"layout": "pinhole", "size": (5, 9)}
LAYOUTS = (("equirect", "ray"), ("pinhole", "ray"), ("cubemap", "ray"), ("pinhole", "ewa"), ("cubemap", "ewa"))
RED_GREEN = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
INTERPRETED = ("one, equirect", "small, cubemap ewa", "inside", "stack of 0.9", "odd size 5", "needles x ray")
"""The cases that also run under Triton's interpreter; a GPU runs all."""
NOT_NUMERIC = ("crowd", "degree", "odd size", "more tiles", "2 channels", "32 channels")
"""Cases in which torch's formulas are as exact in float32 as in others; float64 runs them."""
TRUTHS: dict[str, dict] = {}


def list_cases() -> Iterator[tuple[str, Case]]:
    """The scenes, and how they are drawn: options of `rasterize`, and `slack`, `fields`, `pose`."""

    def noise(*shape: int, seed: int = 0) -> Tensor:
        return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    def change(scene: Gaussians, **fields: Any) -> Gaussians:
        fields = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in fields.items()}
        return dataclasses.replace(scene, **fields)

    def unit(scene: Gaussians, factor: float) -> Gaussians:
        return change(scene, means=factor * scene.means, scales=factor * scene.scales)

    # All options, with few Gaussians, and with more than one block of them in each of several tiles
    one = change(make_spheres((1.0, -0.7, 1.2)), scales=[[0.4, 0.2, 0.3]], quats=[[0.8, 0.3, -0.4, 0.2]])
    small, crowd = make_scene(14, scale=0.25, seed=3, degree=1), make_scene(200, scale=0.15, seed=1)
    channels = change(small, harmonics=small.harmonics.repeat(1, 1, 11)[:, :, :32])
    for layout, kernel in LAYOUTS:
        way = {"layout": layout, "kernel": kernel, "vertical_fov_degrees": 80.0, "pose": POSE}
        yield f"small, {layout} {kernel}", (small, way | {"face_size": 9})
        large = {"size": (50, 70) if layout == "pinhole" else (40, 80)}
        yield f"crowd, {layout} {kernel}", (crowd, way | large)
        yield f"one, {layout}{' ewa' * (kernel == 'ewa')}", (one, {"layout": layout, "kernel": kernel})
    for count in (1, 2, 32):
        yield f"{count} channels", (change(small, harmonics=channels.harmonics[..., :count]), {})
    for degree in range(5):
        yield f"degree {degree}", (make_scene(5, scale=0.4, degree=degree, seed=7), {"pose": POSE})
    yield "clamped colours", (make_spheres((0, 0, 2.0), 1.0, colours=(-0.1, 0.05, 1.5)), {})

    # Places
    on_edge, at_corner = make_spheres((1.4, 0, 1.4), 0.3), make_spheres((1.2, 1.2, 1.2), 0.4)
    for kernel in ("ray", "ewa"):
        for num in (1, 2, 3, 5, 7):
            size = (7, 15) if kernel == "ray" else (8, 16)
            faces = {"size": size, "layout": "cubemap", "face_size": num, "kernel": kernel}
            yield f"edge, {kernel} of {num} pixels", (on_edge, faces)
            yield f"corner, {kernel} of {num} pixels", (at_corner, faces)
        beside = [(14 * 0.3, 0.1, 0.3), (-0.5, 0.9, 0.21), (0.3, 1.4, 1.0), (0.1, -0.1, 2.0)]
        outside = make_spheres(beside, [1.5, 0.4, 0.5, 0.3], colours=noise(4, 3).abs())
        yield f"outside the view, {kernel}", (outside, PINHOLE | {"kernel": kernel, "fields": NO_QUATS})
        behind = make_spheres([(0, 0, -2.0), (0.5, 0.2, -2.0), (1.0, 0, -0.9)], 0.1)
        yield f"behind, {kernel}", (behind, PINHOLE | {"vertical_fov_degrees": 100.0, "kernel": kernel})
    for name, mean in {"up": (0, -2.0, 0), "down": (0, 2.0, 0), "seam": (0, 0.3, -2.0)}.items():
        yield name, (make_spheres(mean, 0.5), {})
    around = make_scene(8, scale=1.2, extent=0.6, seed=2, degree=0)
    around = around.select(around.means.norm(dim=1) > 0.1)
    yield "inside", (around, {})
    yield "inside, pinhole", (around, PINHOLE | {"vertical_fov_degrees": 140.0})
    for distance in (0.0, 1e-6, 0.5 * (1 - 1e-5), 0.5 * (1 + 1e-5)):
        yield (
            f"near, {distance}",
            (make_spheres([(0, 0, distance), (0, 0.4, 2.0)], 0.2), {"near": 0.5, "fields": NO_QUATS}),
        )

    for depth in (0.3, 0.08, 0.5):  # the official code's bound is a fifth of `near`, along a face's axis
        two = make_spheres([(0, 0, depth), (0, 0.4, 2.0)], 0.05)
        yield f"near, ewa {depth}", (two, {"near": 0.45, "layout": "cubemap", "kernel": "ewa", "fields": NO_QUATS})

    # Order
    pair = make_spheres([(0.4, 0.1, 2.0)] * 2, 0.4, colours=RED_GREEN)
    ties = Gaussians.cat([pair, make_scene(9, degree=0), pair.select(torch.tensor([1, 0, 0]))])
    for layout, kernel in (("equirect", "ray"), ("cubemap", "ray"), ("cubemap", "ewa")):
        yield f"ties, {layout} {kernel}", (ties, {"layout": layout, "kernel": kernel})

    # Shapes
    for axis, name in enumerate("xyz"):
        for kernel in ("ray", "ewa"):
            scales = torch.full((2, 3), 1e-2 if kernel == "ray" else 1e-4, dtype=torch.float64)  # the filter hides less
            scales[:, axis] = 1.0
            needles = change(
                make_spheres([(0.1, 0.1, 2.0), (-0.6, 0.3, 1.5)], colours=noise(2, 3).abs()),
                scales=scales,
                quats=[[0.95, 0.1, -0.05, 0.2], [1.0, 0, 0, 0]],
            )
            options = PINHOLE | {"kernel": kernel, "fields": NO_QUATS}
            yield f"needles {name} {kernel}", (needles, options)
    flat = {"disc": (0.5, 0.5, 0), "disc on edge": (0, 0.5, 0.5), "line": (0, 0, 0.5), "aside": (0.5, 0, 0)}
    for name, scales in (flat | {"point": (0, 0, 0)}).items():
        for kernel in ("ray", "ewa"):
            shape = change(make_spheres((0.02, 0.01, 2.0)), scales=[scales])
            options = PINHOLE | {"kernel": kernel, "fields": NO_QUATS}
            yield f"{name}, {kernel}", (shape, options)
    count, apart, focal = 9, 5, 1000.0
    grid = torch.stack(torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij"), dim=-1).double()
    grid = (grid.reshape(-1, 2) * (apart + 1 / count) + 2.5 - 0.5 * count * apart) / focal  # all sub-pixel positions
    ahead = torch.nn.functional.normalize(torch.nn.functional.pad(grid, (0, 1), value=1.0), dim=1)
    fov = 2 * math.degrees(math.atan(0.5 * count * apart / focal))
    options = PINHOLE | {"size": (count * apart,) * 2, "vertical_fov_degrees": fov, "fields": NO_QUATS, "slack": 4}
    for kernel in ("ray", "ewa"):
        yield f"specks, {kernel}", (make_spheres(ahead, 0.05 / focal, 1.0), options | {"kernel": kernel})
    turned = make_scene(8, scale=0.3, degree=0)
    for factor in (-1.0, 2.0, 1e-6, 1e6):
        yield f"quaternions times {factor}", (change(turned, quats=factor * turned.quats), {"pose": POSE})
    yield "quaternions of zero", (change(turned, quats=0 * turned.quats), {"pose": POSE, "fields": NO_QUATS})

    # Light
    for opacity in (0.0, -0.5, -1e29, (1 - 1e-3) / 255, (1 + 1e-3) / 255, 0.5, 1.0, 5.0, 1e29):
        yield (
            f"opacity {opacity:.4g}",
            (make_spheres((0, 0, 2.0), 1.9, opacity), LIGHT | {"size": (5, 5), "vertical_fov_degrees": 10.0}),
        )
    for opacity in (0.3, 0.9, 0.999):
        far = 2 + 0.01 * torch.arange(12, dtype=torch.float64)
        means = torch.stack((0 * far, 0 * far, far), dim=1) + 0.2 * noise(12, 3, seed=2) * torch.tensor((1.0, 1, 0))
        stack = make_spheres(means, 0.9, opacity, noise(12, 3).abs())
        yield f"stack of {opacity}", (stack, LIGHT | {"fields": NO_QUATS})

    # Units and sizes
    some = make_scene(10, scale=0.5, degree=0)
    some = some.select((some.means - POSE[:3, 3]).norm(dim=1) > 0.2)
    for metre in (1e-18, 1e-9, 1e-3, 1e4, 1e9, 1e18):
        camera = POSE.clone()
        camera[:3, 3] *= metre
        for layout, kernel in (LAYOUTS[0], LAYOUTS[4]):
            options = {"layout": layout, "kernel": kernel, "near": 0.05 * metre, "pose": camera}
            yield f"metre of {metre}, {kernel}", (unit(some, metre), options | {"metre": metre})
    distances = (1e-3, 1e-2, 1e-1, 1.0, 1e1)
    means = [(0.3 * r * (-1) ** i, 0.1 * r, r) for i, r in enumerate(distances)]
    wide = make_spheres(means, [0.15 * r for r in distances], 0.5, noise(5, 3).abs())
    yield "millimetre to ten metres", (wide, {"near": 1e-4, "fields": NO_QUATS})
    five = make_spheres(2 * torch.nn.functional.normalize(noise(5, 3, seed=1), dim=1), 0.6)
    for height in (1, 2, 3, 5, 17, 31, 33, 100):
        yield f"odd size {height}", (five, {"size": (height, 2 * height + height % 3), "fields": NO_QUATS})
        yield f"odd size {height}, pinhole", (five, PINHOLE | {"size": (height, height + 3), "fields": NO_QUATS})
    three = make_spheres([(0, 0.1, 2.0), (-1.0, 0.2, 0.9), (0.3, -0.5, -1.0)], 0.1)
    yield "more tiles than Gaussians", (three, {"size": (256, 512), "fields": NO_QUATS})


CASES = dict(list_cases())


@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients_equal_the_dense_renderers(case: str, render: Renderer) -> None:
    scene, options = CASES[case]
    if options.get("kernel") == "ewa" and render.name == "auto":
        pytest.skip("numba has no EWA kernel")
    if render.interpreted and case not in INTERPRETED:
        pytest.skip("takes too long under Triton's interpreter")
    if render.name == "torch" and render.dtype == torch.float32 and case.startswith(NOT_NUMERIC):
        pytest.skip("as exact as other cases")
    assert_dense(render, scene, options, TRUTHS.setdefault(case, {}))
