"""What drivers of graphics cards answer and software OpenGL does not: errors, limits, exhausted memory."""

import contextlib
import itertools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import moderngl
import numpy as np
import pytest

from pansplat.errors import InputError
from pansplat_viewer.draw.gpu_sort import GpuSplats
from pansplat_viewer.draw.layers import TargetStore
from pansplat_viewer.draw.programs import STORED_BYTES, Programs, Resources, checking_memory, set_uniforms
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer
from pansplat_viewer.scene.camera import Pinhole

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


@pytest.mark.parametrize("tier", ["gl33", "gl43"])
def test_a_scene_replaces_one_beside_which_it_has_no_place(ctx, make, random_scene, pose, tier):
    driver = Driver(ctx)
    renderer = make(driver, tier=tier)
    renderer.upload(random_scene(seed=1))
    expected = draw(renderer, pose)
    needed = sum(size for buffer, size in driver._sizes.items() if not is_released(buffer))
    renderer = make(Driver(ctx, memory=round(1.5 * needed)), tier=tier)
    renderer.upload(random_scene())
    draw(renderer, pose)
    renderer.upload(random_scene(seed=1))
    assert np.array_equal(draw(renderer, pose), expected)
    with pytest.raises(MemoryError):
        renderer.upload(random_scene(600))
    assert renderer.stats.total == 300 and np.array_equal(draw(renderer, pose), expected), "the scene before is kept"


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


def refuse_compute(source: str) -> moderngl.ComputeShader:
    raise moderngl.Error("GLSL Compiler failed: internal error")


def test_a_driver_that_refuses_a_compute_shader_draws_with_opengl_3_3(ctx, make, random_scene, pose):
    expected = make(Driver(ctx), tier="gl33")
    expected.upload(random_scene())
    renderer = make(Driver(ctx, compute_shader=refuse_compute))
    assert renderer.tier == "gl43"
    for _ in range(2):
        renderer.upload(random_scene())
        assert renderer.tier == renderer.stats.tier == "gl33"
    assert np.array_equal(draw(renderer, pose), draw(expected, pose)) and renderer.stats.drawn > 0


def test_an_error_that_is_not_of_memory_leaves_the_scene_untouched(ctx, make, random_scene, pose, monkeypatch):
    renderer = make(Driver(ctx), tier="gl43")
    renderer.upload(random_scene())
    before, painter = draw(renderer, pose), renderer._painter
    monkeypatch.setattr(Programs, "compile_compute", lambda self: refuse_compute(""))
    with pytest.raises(moderngl.Error, match="Compiler failed"):
        renderer.upload(random_scene(seed=1))
    assert renderer._painter is painter and np.array_equal(draw(renderer, pose), before)


def test_a_scene_beyond_the_storage_buffers_is_sorted_on_the_processor(ctx, make, random_scene, pose):
    limit = {"GL_MAX_SHADER_STORAGE_BLOCK_SIZE": 200 * STORED_BYTES}
    renderer = make(Driver(ctx, info=ctx.info | limit))
    for count, tier in ((150, "gl43"), (300, "gl33"), (150, "gl43")):
        renderer.upload(random_scene(count))
        assert renderer.tier == tier and draw(renderer, pose)[..., 3].max() > 0.1
    with pytest.raises(InputError, match="storage buffer of 14,400 bytes for 300 Gaussians"):
        make(Driver(ctx, info=ctx.info | limit), tier="gl43").upload(random_scene(300))


def test_every_compute_shader_is_compiled_before_the_first_frame(ctx, make, random_scene, pose):
    renderer = make(Driver(ctx), tier="gl43")
    renderer.upload(random_scene())
    compiled = set(renderer._programs._compiled)
    draw(renderer, pose)
    assert not [key for key in set(renderer._programs._compiled) - compiled if str(key[0]).endswith(".comp")]


def test_commands_that_share_a_buffer_are_separated_by_barriers(pose):
    """A card may run two commands at once, and in any order, unless a barrier is between them."""
    commands: list[str] = []

    def record(command: str) -> Callable[..., None]:
        return lambda *_, **__: commands.append(command)

    program = Mock(run=record("compute"), run_indirect=record("compute"), extra=Mock(__contains__=lambda *_: True))
    program.get.return_value = None
    programs = Mock(project_compute=lambda: program, compute=lambda *_, **__: program)
    ctx = Mock(memory_barrier=record("barrier"))
    splats = GpuSplats(ctx, programs, Resources(), Mock(), Mock(), Mock(), count=350, capacity=100)
    camera = Pinhole(pose[:3, :3], (0.0, 0.0, 0.0), 60.0, *SIZE)
    quads = Mock(render_indirect=record("draw"))
    for position in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)):
        splats.draw(quads, [camera], position, np.ones(350, bool), "all", SETTINGS, 1e-4)
    assert commands.count("draw") == 8, "four chunks each"
    assert all("barrier" in pair for pair in itertools.pairwise(commands))


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


@pytest.mark.parametrize("tier", ["gl33", "gl43"])
def test_a_window_does_not_wait_for_the_frame_that_it_draws(ctx, make, random_scene, pose, tier):
    finish = Mock()
    renderer = make(Driver(ctx, finish=finish, query=lambda time: Timer(10**12)), tier=tier)
    renderer.upload(random_scene())
    renderer.render(pose, SIZE, SETTINGS)
    assert finish.call_count == 1 and renderer.stats.frame_ms == 1e6 and renderer.stats.timed == SETTINGS
    drawn = renderer.stats.drawn
    coarse, moved = DrawSettings(scale=0.5), pose.copy()
    for settings, timed in ((coarse, None), (SETTINGS, coarse), (coarse, SETTINGS)):
        moved[:3, :3] = moved[:3, :3] @ np.diag((-1.0, 1.0, -1.0))  # else nothing is drawn anew
        renderer.render(moved, SIZE, settings, wait=False)
        assert renderer.stats.timed == timed and renderer.stats.frame_ms == (0.0 if timed is None else 1e6)
        assert tier == "gl33" or (renderer.stats.drawn > 0) == (timed is not None), "the GPU counts"
    assert finish.call_count == 1
    renderer.render(pose, SIZE, SETTINGS)
    assert renderer.stats.drawn == drawn, "not those of the frame before"


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
