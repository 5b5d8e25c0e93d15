"""Fixtures of the tests of renderers: backends."""

import os
from importlib.util import find_spec

import dense_renderer
import pytest
import torch

_TRITON = (
    pytest.mark.exhaustive,
    pytest.mark.skipif(find_spec("triton") is None and not os.environ.get("CI"), reason="triton needs Linux"),
)


@pytest.fixture(params=[*list(dense_renderer.BACKENDS)[:3], pytest.param("triton", marks=_TRITON)])
def render(request: pytest.FixtureRequest) -> dense_renderer.Renderer:
    """A backend; Triton's on a GPU or by its interpreter, with -m exhaustive."""
    if request.param == "triton":
        request.getfixturevalue("triton_device")
    return dense_renderer.BACKENDS[request.param]


@pytest.fixture(scope="session")
def triton_device() -> str:
    """The device of Triton's kernels: "cuda", or without one "cpu" under Triton's interpreter."""
    if torch.cuda.is_available():
        return "cuda"
    os.environ["TRITON_INTERPRET"] = "1"
    import triton.language as tl
    from triton.runtime import interpreter

    assert isinstance(tl.sum, interpreter.InterpretedFunction), (
        "triton was imported before TRITON_INTERPRET=1 was set; set it at the head of the conftest.py"
    )
    # It patches its language at every call of a device function; once is enough, and six times faster.
    interpreter._patch_lang(tl.sum.fn)
    interpreter.InterpretedFunction.__call__ = lambda self, *args, **kwargs: self.rewrite()(*args, **kwargs)
    return "cpu"
