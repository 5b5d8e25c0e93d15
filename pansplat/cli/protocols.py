"""`pansplat evaluate --protocol`: a table of the paper, its rows and ours."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from pansplat import pipeline
from pansplat.cli.commands import Evaluate, LpipsChoice
from pansplat.cli.printing import table_console
from pansplat.cli.scenes import progress_bar, require_height
from pansplat.errors import InputError
from pansplat.evaluation.lpips import MIN_IMAGE_SIZE, Backbone, Lpips, find_backbone, load_lpips
from pansplat.evaluation.protocol import Blend, Method, ProtocolOptions, list_methods, run_protocol
from pansplat.evaluation.tables import report_notes, rich_tables, write_report
from pansplat.model.weights import WEIGHTS_SUFFIXES

_WIDTH = 150  # characters, where there is no terminal


def run_evaluate_protocol(command: Evaluate) -> int:
    """Run the protocol on the data that is here, print the tables and write the files."""
    protocol, choice = command.protocol.protocol, command.protocol
    assert protocol is not None
    _check(command)
    options = ProtocolOptions(command.height, choice.limit, choice.pictures)
    lpips = choose_lpips(command.lpips, command.height)
    methods = _methods(command, protocol)
    assert choice.data is not None
    with progress_bar() as progress:
        result = run_protocol(
            protocol, choice.data.expanduser(), methods, command.out, options=options, lpips=lpips, progress=progress
        )
    written = write_report(result, command.out)
    console = table_console(_WIDTH)
    for table in rich_tables(result):
        console.print(table)
    for note in report_notes(result):
        console.print(note, markup=False, soft_wrap=True)
    print(", ".join(str(path) for path in (command.out / "results.json", *written)))
    return 0


def choose_lpips(choice: LpipsChoice, height: int) -> Lpips | None:
    """LPIPS as asked for; None where it is not wanted, or "auto" finds no weights or too small pictures.

    Raises:
        InputError: a classifier is asked for by name, and its files are missing.
    """
    if choice.lpips == "none":
        return None
    if choice.lpips != "auto":
        return load_lpips(cast(Backbone, choice.lpips), choice.lpips_weights)
    backbone = find_backbone(choice.lpips_weights) if height >= MIN_IMAGE_SIZE else None
    return load_lpips(backbone, choice.lpips_weights) if backbone else None


def _methods(command: Evaluate, protocol: str) -> list[Method]:
    """The rows of all predictors; weights are called by their file's name."""
    blend = cast("Blend | None", command.blend)
    methods: list[Method] = []
    for index, model in enumerate((command.model, *command.protocol.models)):
        with_compat = index == 0 or Path(model).suffix.lower() in WEIGHTS_SUFFIXES  # sweep among the others has none
        compat, precision = (command.compat, command.precision) if with_compat else ("trained", "float32")
        predictor = pipeline.load_model(model, compat=compat, precision=precision)
        methods += list_methods(predictor, protocol, blend, Path(model).stem, command.drawing)
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"--model and --models must have names of their own, got {', '.join(names)}; rename a file")
    return methods


def _check(command: Evaluate) -> None:
    """Refuse what has no meaning with a protocol."""
    require_height(command.height)
    if command.paths:
        raise InputError(
            f"--protocol takes its data from --data, got the folder {command.paths[0]} as well; leave it out"
        )
    if command.protocol.data is None:
        raise InputError("--protocol needs --data, the folder that holds the data sets")
    if command.blend not in (None, "joint", "deferred"):
        raise InputError(f"--blend must be joint or deferred with --protocol, got {command.blend!r}")
    for name in ("near", "far", "convention"):
        if getattr(command, name) is not None:
            raise InputError(f"--{name} is the protocol's to say; leave it out")
    if command.protocol.limit is not None and command.protocol.limit < 1:
        raise InputError(f"--limit must be at least 1, got {command.protocol.limit}")
