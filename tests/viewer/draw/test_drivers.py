"""What drivers of graphics cards answer and software OpenGL does not: errors, limits, exhausted memory."""

import contextlib
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import moderngl
import numpy as np
import pytest

from pansplat_viewer.draw.layers import TargetStore
from pansplat_viewer.draw.programs import Programs, checking_memory, set_uniforms
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer

pytestmark = pytest.mark.gl

SIZE, SETTINGS = (48, 32), DrawSettings()


class Driver:
    """The context of the tests, with `memory` bytes for buffers, and other answers where a test sets them.

    As with NVIDIA's and Mesa's drivers, a buffer that does not fit is created, and an error is recorded.
    """

    def __init__(self, ctx: moderngl.Context, memory: int = 1 << 40, **answers: object) -> None:
        vars(self).update(_ctx=ctx, _sizes={}, _errors=[], _memory=memory, **answers)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ctx, name)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._ctx, name, value)

    def buffer(self, data: Any = None, reserve: int = 0, dynamic: bool = False) -> moderngl.Buffer:
        buffer = self._ctx.buffer(data, reserve=reserve, dynamic=dynamic)
        self._sizes[buffer] = buffer.size
        if sum(size for each, size in self._sizes.items() if not is_released(each)) > self._memory:
            self._errors.append("GL_OUT_OF_MEMORY")
        return buffer

    @property
    def error(self) -> str:
        return self._errors.pop(0) if self._errors else self._ctx.error


def is_released(buffer: moderngl.Buffer) -> bool:
    return isinstance(buffer.mglo, moderngl.mgl.InvalidObject)


@pytest.fixture
def make(ctx) -> Any:
    """Creates a renderer on a driver; all are released."""
    renderers = []

    def make(driver: Driver, **options: Any) -> SplatRenderer:
        renderers.append(SplatRenderer(driver, color_bits=32, **options))
        return renderers[-1]

    yield make
    for renderer in renderers:
        renderer.release()


def draw(renderer: SplatRenderer, pose: np.ndarray) -> np.ndarray:
    renderer.render(pose, SIZE, SETTINGS)
    return renderer.read_color()


def test_memory_that_moderngl_does_not_see_is_an_error(ctx):
    """The driver of the tests records the error, too."""
    with pytest.raises(MemoryError, match="the GPU's memory is exhausted"), checking_memory(ctx):
        ctx.buffer(reserve=1 << 46).release()
    with checking_memory(ctx):
        ctx.buffer(reserve=16).release()


def test_errors_before_the_block_are_not_its_errors_and_a_lost_context_ends_the_search():
    ctx = SimpleNamespace(error="GL_NO_ERROR")
    with checking_memory(ctx):
        pass
    with pytest.raises(moderngl.Error, match="GL_INVALID_VALUE"), checking_memory(ctx):
        ctx.error = "GL_INVALID_VALUE"
    with pytest.raises(moderngl.Error, match="GL_UNKNOWN_ERROR"):  # in answer to every question
        ctx.error = "GL_UNKNOWN_ERROR"
        with checking_memory(ctx):
            pass


def test_a_scene_replaces_one_beside_which_it_has_no_place(ctx, make, random_scene, pose):
    driver = Driver(ctx)
    renderer = make(driver)
    renderer.upload(random_scene(seed=1))
    expected = draw(renderer, pose)
    needed = sum(size for buffer, size in driver._sizes.items() if not is_released(buffer))
    renderer = make(Driver(ctx, memory=round(1.5 * needed)))
    renderer.upload(random_scene())
    draw(renderer, pose)
    renderer.upload(random_scene(seed=1))
    assert np.array_equal(draw(renderer, pose), expected)
    with pytest.raises(MemoryError):
        renderer.upload(random_scene(600))
    assert np.array_equal(draw(renderer, pose), expected), "the scene before is kept"


def test_an_image_without_memory_is_an_error_and_can_be_drawn_smaller(ctx):
    limited = Mock(wraps=ctx, fbo=None, screen=None, info=ctx.info, error="GL_NO_ERROR")

    def refuse(attachments: list[moderngl.Texture]) -> moderngl.Framebuffer:
        if attachments[0].width > 32:
            limited.error = "GL_OUT_OF_MEMORY"
            raise moderngl.Error("the framebuffer is not complete (INCOMPLETE_ATTACHMENT)")
        return ctx.framebuffer(attachments)

    limited.framebuffer = refuse
    store = TargetStore(limited, color_bits=16)
    small = store.get("image", (32, 32))
    with pytest.raises(MemoryError, match="INCOMPLETE_ATTACHMENT"):
        store.get("image", (64, 32))
    limited.error = "GL_NO_ERROR"
    assert store.get("image", (32, 32)) is not small, "the smaller one was released first"
    store.release()


def test_a_uniform_that_no_shader_has_is_an_error(ctx):
    programs = Programs(ctx)
    set_uniforms(programs.accumulate(0), focal=1.0)  # which the compiler removes from this variant
    with pytest.raises(KeyError, match=r"no uniform 'wieght'; it has .*weight"):
        set_uniforms(programs.accumulate(0), wieght=1.0)
    programs.release()


class Timer(contextlib.nullcontext):
    """A query that measures the same time of every frame, nanoseconds."""

    def __init__(self, elapsed: int) -> None:
        super().__init__()
        self.elapsed = elapsed


def test_a_window_does_not_wait_for_the_frame_that_it_draws(ctx, make, random_scene, pose):
    finish = Mock()
    renderer = make(Driver(ctx, finish=finish, query=lambda time: Timer(10**12)))
    renderer.upload(random_scene())
    renderer.render(pose, SIZE, SETTINGS)
    assert finish.call_count == 1 and renderer.stats.frame_ms == 1e6 and renderer.stats.timed == SETTINGS
    coarse, moved = DrawSettings(scale=0.5), pose.copy()
    for settings, timed in ((coarse, None), (SETTINGS, coarse), (coarse, SETTINGS)):
        moved[:3, :3] = moved[:3, :3] @ np.diag((-1.0, 1.0, -1.0))  # else nothing is drawn anew
        renderer.render(moved, SIZE, settings, wait=False)
        assert renderer.stats.timed == timed and renderer.stats.frame_ms == (0.0 if timed is None else 1e6)
    assert finish.call_count == 1


def test_a_frame_beyond_the_32_bits_of_the_timer_takes_at_least_the_time_that_it_is_waited_for(
    ctx, make, random_scene, pose, monkeypatch
):
    class LongTimer(contextlib.nullcontext):
        seconds = 0.0

        @property
        def elapsed(self) -> int:
            self.seconds += 5.0
            return (5 * 10**9) % 2**32

    timer = LongTimer()
    monkeypatch.setattr("pansplat_viewer.draw.renderer.time", Mock(perf_counter=lambda: timer.seconds))
    renderer = make(Driver(ctx, query=lambda time: timer))
    renderer.upload(random_scene(20))
    for _ in range(2):
        renderer.render(pose, SIZE, SETTINGS, wait=False)
    assert renderer.stats.frame_ms == 5000


def test_each_frame_is_waited_for_where_the_driver_measures_no_time(ctx, make, random_scene, pose):
    finish = Mock()
    renderer = make(Driver(ctx, finish=finish, query=lambda time: Timer(0)))
    renderer.upload(random_scene())
    for count in range(1, 4):
        renderer.render(pose, SIZE, SETTINGS, wait=False)
        assert finish.call_count == count - 1
