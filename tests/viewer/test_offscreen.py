"""Contexts without a window, and the same picture on every version of OpenGL."""

import importlib.util
import os
import subprocess
import sys

import moderngl
import numpy as np
import pytest

from pansplat.errors import InputError
from pansplat_viewer import offscreen
from pansplat_viewer.programs import choose_tier
from pansplat_viewer.renderer import DrawSettings

pytestmark = pytest.mark.gl

# What Mesa needs to behave like macOS: an old version and no compute, storage buffers or images.
_WITHOUT = " ".join(
    f"-GL_ARB_{name}"
    for name in (
        "compute_shader",
        "compute_variable_group_size",
        "shader_storage_buffer_object",
        "shader_image_load_store",
        "shader_image_size",
    )
)


def _emulated(version: str) -> dict[str, str]:
    return {
        "MESA_GL_VERSION_OVERRIDE": version,
        "MESA_GLSL_VERSION_OVERRIDE": version.replace(".", "") + "0",
        "MESA_EXTENSION_OVERRIDE": _WITHOUT,
    }


# Draws the given scene in every kernel and layout and says what it drew on.
_DRAW = """
import sys
import numpy as np, torch
from pansplat.gaussians.scene import Gaussians
from pansplat.gaussians.scene import Scene
from pansplat_viewer.offscreen import create_context
from pansplat_viewer.renderer import DrawSettings, SplatRenderer

scene_file, out, backend = sys.argv[1:]
scene = torch.load(scene_file, weights_only=True)
ctx = create_context(backend)
renderer = SplatRenderer(ctx, color_bits=32)
renderer.upload(Scene(Gaussians(**scene["gaussians"]), scene["cam2world"], 0.45, 10.0))
pictures = {"version": ctx.version_code, "tier": renderer.tier}
for kernel in ("ray", "ewa"):
    for layout in ("pinhole", "equirect"):
        settings = DrawSettings(kernel=kernel, layout=layout, mode="deferred")
        renderer.render(scene["pose"].numpy(), (64, 48), settings)
        pictures[f"{kernel} {layout}"] = renderer.read_color()
settings = DrawSettings(cached=True)
renderer.render(scene["pose"].numpy(), (64, 48), settings)
pictures["cached"] = renderer.read_color()
assert ctx.error == "GL_NO_ERROR", ctx.error
np.savez(out, **pictures)
"""


@pytest.fixture
def draw_in_subprocess(random_scene, pose, tmp_path):
    """Draws the random scene in another process under the given environment."""
    import torch

    scene = random_scene()
    fields = vars(scene.gaussians)
    stored = {"gaussians": dict(fields), "cam2world": scene.cam2world, "pose": torch.from_numpy(pose)}
    torch.save(stored, tmp_path / "scene.pt")

    def draw(environment: dict[str, str], backend: str = "egl") -> dict[str, np.ndarray]:
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}.npz"
        command = [sys.executable, "-c", _DRAW, str(tmp_path / "scene.pt"), str(out), backend]
        done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        with np.load(out) as pictures:
            return dict(pictures)

    return draw


@pytest.mark.parametrize("version", ["3.3", "4.1"])
def test_old_opengl_draws_the_same_picture(draw_in_subprocess, renderer, random_scene, pose, version):
    old = draw_in_subprocess(_emulated(version))
    assert old["version"] == int(version.replace(".", "") + "0")
    assert old["tier"] == "gl33"
    drawn = renderer(random_scene())
    for kernel in ("ray", "ewa"):
        for layout in ("pinhole", "equirect"):
            settings = DrawSettings(kernel=kernel, layout=layout, mode="deferred")
            drawn.render(pose, (64, 48), settings)
            assert np.abs(drawn.read_color() - old[f"{kernel} {layout}"]).max() <= 1e-5
    drawn.render(pose, (64, 48), DrawSettings(cached=True))
    assert np.abs(drawn.read_color() - old["cached"]).max() <= 1e-5


def test_osmesa_draws_the_same_picture(draw_in_subprocess, renderer, random_scene, pose):
    try:
        offscreen._load_osmesa()
    except OSError as error:
        if os.environ.get("CI"):
            pytest.fail(f"{error}; install libosmesa6")
        pytest.skip(f"{error}; Mesa 25.1 dropped it")
    osmesa = draw_in_subprocess({}, "osmesa")
    drawn = renderer(random_scene())
    drawn.render(pose, (64, 48), DrawSettings(mode="deferred"))
    assert np.abs(drawn.read_color() - osmesa["ray pinhole"]).max() <= 1e-5


def test_missing_opengl_names_the_packages(monkeypatch):
    def fail(**_):
        raise Exception("libEGL not loaded")

    def fail_too():
        raise OSError("libOSMesa is not installed")

    monkeypatch.setattr(moderngl, "create_context", fail)
    monkeypatch.setattr(offscreen, "_load_osmesa", fail_too)
    with pytest.raises(InputError, match=r"libEGL not loaded.*libOSMesa.*apt-get install libegl1.*libosmesa6"):
        offscreen.create_context()


def test_unknown_backend_and_tier_are_refused(ctx):
    with pytest.raises(InputError, match="auto, egl or osmesa, got 'wgl'"):
        offscreen.create_context("wgl")
    with pytest.raises(InputError, match="auto, gl33 or gl43, got 'gl21'"):
        choose_tier(ctx, "gl21")


def test_tier_follows_the_context():
    class Old:
        version_code = 410

    class New:
        version_code = 430

    assert choose_tier(Old(), "auto") == "gl33"
    assert choose_tier(New(), "auto") == "gl43"
    assert choose_tier(New(), "gl33") == "gl33"
    with pytest.raises(InputError, match=r"needs OpenGL 4.3, this context has 4.1; use tier gl33"):
        choose_tier(Old(), "gl43")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="needs Triton, which is not for this system")
def test_triton_can_be_loaded_after_a_context():
    """Where Mesa's LLVM was first, loading Triton's used to end the process."""
    code = "from pansplat_viewer.offscreen import create_context; create_context(); import torch._dynamo"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
