"""Layers to the picture: one alone, several blended by distance, or two compared."""

from __future__ import annotations

from collections.abc import Hashable

import moderngl
import numpy as np

from pansplat.errors import InputError
from pansplat_viewer.layers import LayerPainter, Shot
from pansplat_viewer.programs import Programs, set_uniforms
from pansplat_viewer.targets import Target, TargetStore

# Least weight of a view in deferred blending, by the bits of the targets: it shows a view only where the others see
# nothing (an input's own masked tripod), and is lost in rounding elsewhere.
_LEAST_WEIGHT = {16: 1e-4, 32: 2.0**-26}


class Composer:
    """Adds weighted layers and finishes the sum over the background.

    Attributes:
        in_use: names of the targets of the last picture.
    """

    def __init__(self, ctx: moderngl.Context, programs: Programs, targets: TargetStore) -> None:
        """Nothing is drawn yet."""
        self._ctx = ctx
        self._programs = programs
        self._targets = targets
        self._gather: dict[int, moderngl.VertexArray] = {}
        self._finish = ctx.vertex_array(programs.finish(), [])
        self.in_use: set[Hashable] = set()

    def compose(self, shot: Shot, painter: LayerPainter) -> Target:
        """The shot's picture: RGB over the background, coverage, and depth where the layers carry it."""
        self.in_use = {"sum 0", "sum 1", "output"}
        sums = [
            self._add(shot, painter, f"sum {i}", terms)
            for i, terms in enumerate(_terms(shot, _LEAST_WEIGHT[self._targets.color_bits]))
        ]
        output = self._targets.get("output", shot.size, depth_components=int(painter.with_depth))
        output.framebuffer.use()
        output.framebuffer.viewport = (0, 0, *shot.size)
        names = ("first_color", "first_depth", "second_color", "second_depth")
        textures = (sums[0].color, sums[0].depth, sums[-1].color, sums[-1].depth)
        program = self._programs.finish()
        set_uniforms(program, difference=len(sums) == 2, background=shot.settings.background)
        self._bind(program, names, textures)
        self._ctx.enable_only(moderngl.NOTHING)
        self._finish.render(moderngl.TRIANGLES, vertices=3)
        return output

    def release(self) -> None:
        """Free the vertex arrays."""
        for vertex_array in self._gather.values():
            vertex_array.release()
        self._finish.release()

    def _add(self, shot: Shot, painter: LayerPainter, name: str, terms: list[tuple[int | None, float]]) -> Target:
        layers = [(painter.layer(view), weight) for view, weight in terms]
        target = self._targets.get(name, shot.size, depth_components=2)
        target.framebuffer.use()
        target.framebuffer.viewport = (0, 0, *shot.size)
        program = self._programs.gather(shot.source)
        if shot.source not in self._gather:
            self._gather[shot.source] = self._ctx.vertex_array(program, [])
        set_uniforms(
            program,
            with_depth=painter.with_depth,
            size=shot.size,
            focal=shot.focal,
            camera_to_faces=np.ascontiguousarray(shot.camera_to_faces.T, dtype=np.float32).tobytes(),
            face_size=shot.face_size,
        )
        self._ctx.enable_only(moderngl.NOTHING)  # the first layer replaces what was there
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE
        for layer, weight in layers:
            set_uniforms(program, weight=weight)
            self._bind(program, ("layer_color", "layer_depth"), (layer.color, layer.depth))
            self._gather[shot.source].render(moderngl.TRIANGLES, vertices=3)
            self._ctx.enable_only(moderngl.BLEND)
        self._ctx.enable_only(moderngl.NOTHING)
        return target

    def _bind(self, program: object, names: tuple[str, ...], textures: tuple[moderngl.Texture | None, ...]) -> None:
        for unit, (name, texture) in enumerate(zip(names, textures, strict=True)):
            # A sampler that is not read still needs a texture of its kind.
            (texture or textures[0]).use(location=unit)  # type: ignore[union-attr]
            set_uniforms(program, **{name: unit})


def _terms(shot: Shot, least_weight: float) -> list[list[tuple[int | None, float]]]:
    """Which layers with which weights make the picture, or the two pictures of mode `difference`."""
    settings, count = shot.settings, shot.splats.num_views
    if settings.mode == "joint":
        return [[(None, 1.0)]]
    if settings.mode in ("view", "difference") and not 0 <= settings.view < max(count, 1):
        raise InputError(f"`view` must be 0..{max(count, 1) - 1} in this scene, got {settings.view}")
    if settings.mode == "view":
        return [[(settings.view, 1.0)]]
    if settings.mode == "difference":
        return [[(settings.view, 1.0)], [((settings.view + 1) % max(count, 1), 1.0)]]
    if count < 2:
        return [[(None, 1.0)]]
    positions = shot.splats.view_positions
    if len(positions) != count:
        raise InputError(
            f"mode deferred needs the camera of each context view, the scene has {len(positions)} cameras "
            f"for {count} views; use mode joint"
        )
    import torch

    from pansplat.geometry.pose import blend_weights

    weights = blend_weights(torch.from_numpy(shot.world_position.copy()), torch.from_numpy(positions))
    return [[(view, max(weight, least_weight)) for view, weight in enumerate(weights.tolist())]]
