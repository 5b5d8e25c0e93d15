"""The viewer: GLSL splats in a window or offscreen. Installed as `pansplat_viewer`. `pansplat-view` runs it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

if __name__ != "pansplat_viewer":
    raise ImportError(
        f"the folder `viewer/` is the package `pansplat_viewer`, but was imported as `{__name__}`; "
        "install the project (`pip install -e .`) and `import pansplat_viewer`"
    )


def main() -> NoReturn:
    """Run `pansplat-view` and exit with its status (docs/errors.md)."""
    sys.exit(run())


def run(args: Sequence[str] | None = None) -> int:
    """Run `pansplat-view` and return its exit status; help and misspelt arguments raise SystemExit."""
    from pansplat.system.console import run_command

    def run_arguments() -> int:  # imported after the signals are caught
        from pansplat_viewer.app import run_arguments

        return run_arguments(args)

    return run_command(
        run_arguments,
        memory_advice="choose a smaller --height or --size.",
        interruption="no incomplete file is left behind",
    )
