"""Training: losses, deferred backpropagation, and the training loop. `pansplat-train PRESET` runs it."""


def main() -> None:
    """Run `pansplat-train` and exit with its status."""
    from pansplat.training.__main__ import main

    main()
