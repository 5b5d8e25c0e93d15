"""Contexts without a window, and the same image on every version of OpenGL."""

import importlib.util
import inspect
import os
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import Mock

import moderngl
import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat_viewer.draw import offscreen
from pansplat_viewer.draw.renderer import DrawSettings

pytestmark = pytest.mark.gl


def render_images(renderer, pose):
    """An image that is drawn directly, and one from cached faces."""
    settings = {"deferred": DrawSettings(mode="deferred"), "cached": DrawSettings(cached=True)}
    images = {}
    for name, each in settings.items():
        renderer.render(pose, (64, 48), each)
        images[name] = renderer.read_color()
    return images


# Writes the images of the given scene, and the OpenGL version.
_SCRIPT = f"""
import sys
import numpy as np, torch
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat_viewer.draw.offscreen import create_context
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer

{inspect.getsource(render_images)}
scene_file, out, backend = sys.argv[1:]
scene = torch.load(scene_file, weights_only=True)
ctx = create_context(backend)
renderer = SplatRenderer(ctx, color_bits=32)
renderer.upload(Scene(Gaussians(**scene["gaussians"]), scene["cam2world"], 0.45, 10.0))
images = render_images(renderer, scene["pose"].numpy())
assert ctx.error == "GL_NO_ERROR", ctx.error
np.savez(out, version=ctx.version_code, **images)
"""


@pytest.mark.slow
def test_old_opengl_and_osmesa_render_the_same_images(make_renderer, random_scene, pose, tmp_path, gl_context):
    scene = random_scene()
    expected = render_images(make_renderer(scene), pose)
    if "Mesa" not in gl_context.info["GL_VERSION"]:
        pytest.skip("another driver than Mesa, which alone can disable extensions")
    stored = {"gaussians": vars(scene.gaussians), "cam2world": scene.cam2world, "pose": torch.from_numpy(pose)}
    torch.save(stored, tmp_path / "scene.pt")
    # Mesa behaves like macOS: an old version without compute shaders, storage buffers and images.
    missing = "compute_shader compute_variable_group_size shader_storage_buffer_object shader_image_load_store"
    disabled = " ".join(f"-GL_ARB_{name}" for name in (*missing.split(), "shader_image_size"))
    versions = {"MESA_GL_VERSION_OVERRIDE": "3.3", "MESA_GLSL_VERSION_OVERRIDE": "330"}
    runs = {"330": versions | {"MESA_EXTENSION_OVERRIDE": disabled}}
    try:
        offscreen._load_osmesa()
        runs["osmesa"] = {}
    except OSError as error:  # Mesa 25.1 dropped OSMesa
        if os.environ.get("CI"):
            pytest.fail(f"{error}; install libosmesa6")
    processes = {}
    for name, environment in runs.items():
        backend = "osmesa" if name == "osmesa" else "egl"
        command = [sys.executable, "-c", _SCRIPT, str(tmp_path / "scene.pt"), str(tmp_path / f"{name}.npz"), backend]
        processes[name] = subprocess.Popen(command, env=os.environ | environment, stderr=subprocess.PIPE, text=True)
    for name, process in processes.items():
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
        with np.load(tmp_path / f"{name}.npz") as images:
            if name != "osmesa":
                assert images["version"] == int(name)
            for key, image in expected.items():
                assert np.abs(images[key] - image).max() <= 1e-5, (name, key)


def test_missing_opengl_is_reported_with_the_packages(monkeypatch):
    monkeypatch.setattr(moderngl, "create_context", Mock(side_effect=Exception("libEGL not loaded")))
    monkeypatch.setattr(offscreen, "_load_osmesa", Mock(side_effect=OSError("libOSMesa is not installed")))
    expect_error(r"libEGL not loaded.*libOSMesa.*apt-get install libegl1.*libosmesa6", offscreen.create_context)


@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_windows_and_macos_have_contexts_of_their_own(monkeypatch, system):
    """There is no EGL; Windows has 4.6, macOS has 4.1 whatever is asked for."""
    offered = {"win32": 460, "darwin": 410}[system]

    def create(require, standalone, backend=None):
        if backend is not None:
            raise ImportError(f"cannot import name {backend!r} from 'glcontext'")
        if require > offered:
            raise ValueError(f"Requested OpenGL version {require}, got version {offered}")
        return SimpleNamespace(version_code=offered)

    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(moderngl, "create_context", create)
    assert offscreen.create_context().version_code == offered
    offered = 110  # "GDI Generic": no driver is installed
    expect_error(r"system: Requested .*got version 110\); install the driver of the graphics", offscreen.create_context)


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not available for this system")
def test_triton_can_be_loaded_after_a_context():
    code = "from pansplat_viewer.draw.offscreen import create_context; create_context(); import triton"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
