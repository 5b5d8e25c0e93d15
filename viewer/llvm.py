"""Which LLVM comes first."""

import contextlib


def load_before_mesa() -> None:
    """Load Triton where it is installed; to be called before the first OpenGL context.

    Torch loads Triton sooner or later, and Mesa's software drivers are linked to an LLVM of their own: where that is in
    the process first, loading Triton's ends it with a segmentation fault.
    """
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401
