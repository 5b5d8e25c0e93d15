"""Textures the renderer draws into, and the memory of what they hold."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

import moderngl


class Target:
    """A framebuffer with an RGBA colour texture and, where asked, a float32 texture of `depth_components`.

    Attributes:
        key: what the content was drawn from; None when it holds nothing.
        parts: which parts of it (cube faces; 0 where there is one part) are drawn.
    """

    def __init__(
        self, ctx: moderngl.Context, size: tuple[int, int], *, color_bits: int, depth_components: int = 0
    ) -> None:
        """Allocate; the content is undefined."""
        self._ctx = ctx
        self.size = size
        self.key: Hashable = None
        self.parts: set[int] = set()
        self.color = ctx.texture(size, 4, dtype=f"f{color_bits // 8}")
        self.color.repeat_x = self.color.repeat_y = False
        self.depth = ctx.texture(size, depth_components, dtype="f4") if depth_components else None
        attachments = [self.color] if self.depth is None else [self.color, self.depth]
        self.framebuffer = ctx.framebuffer(attachments)
        self.num_bytes = size[0] * size[1] * (color_bits // 2 + 4 * depth_components)

    def begin(self, key: Hashable) -> None:
        """Forget what was drawn; what comes now is drawn from `key`."""
        self.key = key
        self.parts.clear()

    def release(self) -> None:
        """Free the textures."""
        if self._ctx.fbo is self.framebuffer:
            # moderngl binds what was bound again when it makes a framebuffer, which must then still exist.
            (self._ctx.screen or self._ctx.detect_framebuffer(0)).use()
        self.framebuffer.release()
        self.color.release()
        if self.depth is not None:
            self.depth.release()


class TargetStore:
    """Targets by name, reused while their shape fits; the longest unused go when memory runs short."""

    def __init__(self, ctx: moderngl.Context, *, color_bits: int, budget_bytes: int = 1 << 30) -> None:
        """Nothing is allocated yet."""
        self._ctx = ctx
        self.color_bits = color_bits
        self._budget = budget_bytes
        self._targets: OrderedDict[Hashable, Target] = OrderedDict()

    def get(self, name: Hashable, size: tuple[int, int], *, depth_components: int = 0, key: Hashable = None) -> Target:
        """The target of this name and size, holding either what was drawn from `key` or nothing.

        Depth that was wanted once is kept as long as the content is, and costs nothing after that.
        """
        target = self._targets.get(name)
        if target is not None:
            has = 0 if target.depth is None else target.depth.components
            kept = key is not None and target.key == key
            if target.size != size or has < depth_components or (has > depth_components and not kept):
                target.release()
                target = None
        if target is None:
            target = Target(self._ctx, size, color_bits=self.color_bits, depth_components=depth_components)
            self._targets[name] = target
        if key is None or target.key != key:
            target.begin(key)
        self._targets.move_to_end(name)
        return target

    def trim(self, in_use: set[Hashable]) -> None:
        """Free the longest unused targets beyond the budget, except those in use."""
        total = sum(target.num_bytes for target in self._targets.values())
        for name in [name for name in self._targets if name not in in_use]:
            if total <= self._budget:
                return
            target = self._targets.pop(name)
            total -= target.num_bytes
            target.release()

    def forget(self) -> None:
        """Mark everything as not drawn."""
        for target in self._targets.values():
            target.begin(None)

    def release(self) -> None:
        """Free all targets."""
        for target in self._targets.values():
            target.release()
        self._targets.clear()
