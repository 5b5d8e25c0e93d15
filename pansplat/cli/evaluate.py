"""`pansplat evaluate`: predictions against the panoramas between the inputs, or a table of the paper."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from tyro.conf import Fixed, Positional, Suppress, arg

from pansplat.cli.inputs import Computation, Out, parse_blend
from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.console import make_table_console, progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.files import expand_home, require_output_folder, require_replaceable
from pansplat.system.options import Count, CountOrNone, Height, Seconds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pansplat.evaluation.lpips import Backbone, Lpips
    from pansplat.evaluation.protocol import Blend, Method, ProtocolName
    from pansplat.inputs.pairs import Pair

_WRITTEN = "results.json", "*/prediction.png", "*/target.png", "*/error.png"
_WRITTEN_OF_PROTOCOL = "results.json", "table.md", "*/*/*.png"
_HEIGHT = 512  # pixels, of the paper's panoramas
_PROTOCOL_WIDTH = 150  # characters of a protocol's tables if there is no terminal


@dataclass(frozen=True)
class _Prediction(PredictOptions):
    """How scenes are predicted. The cache is not used, so that times are valid."""

    height: Height | None = _HEIGHT
    refine_seconds: Annotated[Seconds | None, arg(name="refine")] = 0.0
    cache: Annotated[bool, Fixed, Suppress] = False


@dataclass(frozen=True)
class LpipsChoice:
    """Whether to measure LPIPS, and with which weights."""

    lpips: Literal["auto", "vgg", "alex", "squeeze", "none"] = "auto"
    """Backbone of LPIPS; the paper uses vgg. auto: the first whose weights are found, if any."""
    lpips_weights: Path | None = None
    """Folder of its weights; by default the environment variable PANSPLAT_LPIPS, or the torch.hub cache."""


@dataclass(frozen=True)
class ProtocolChoice:
    """The paper's evaluations, instead of folders of pairs."""

    protocol: Literal["m3d", "narrow", "replica", "residential", "360loc"] | None = None
    """One table of the paper, on the data sets that --data holds; missing ones are listed."""
    data: Path | None = None
    """Folder that holds the data sets, for --protocol: png_render_test_* or pano_grf/, 360Loc/."""
    models: tuple[str, ...] = ()
    """More predictors for the table of --protocol: `sweep`, or files of weights."""
    limit: Count | None = None
    """At most this many cases of each test set, evenly spaced; by default all, as in the paper."""
    pictures: CountOrNone = 8
    """Number of cases of each test set whose images are written."""


@dataclass(frozen=True)
class Evaluate(Computation):
    """Compare predictions with the real panoramas between the inputs, and with the cross-fade baseline.

    With --protocol: compute a table of the paper, with the paper's rows and ours.
    """

    paths: Positional[tuple[Path, ...]]
    """Folders of pairs; pairs without target views are skipped. None with --protocol."""
    out: Out
    """Folder for results.json and, for each case, prediction.png, target.png and error.png."""
    prediction: _Prediction = field(default_factory=_Prediction)
    blend: str | None = None
    """deferred, joint, or view0, view1, ...; by default deferred, with --protocol that of the paper's table. For joint,
    each surface is kept once, except of networks."""
    drawing: Literal["exact", "original"] = "exact"
    """exact, or original: render as the official code does, to compare with its published figures."""
    leave_one_out: bool = False
    """Instead of targets: each panorama of a tour against the scene that the tour without it shows there."""
    reading: ReadOptions = field(default_factory=ReadOptions)
    lpips: LpipsChoice = field(default_factory=LpipsChoice)
    protocol: ProtocolChoice = field(default_factory=ProtocolChoice)

    @property
    def _height(self) -> int:
        return self.prediction.height or _HEIGHT

    def run(self) -> int:
        """Evaluate the folders' pairs, or a protocol of the paper."""
        require_output_folder("--out", self.out)
        written = _WRITTEN if self.protocol.protocol is None else _WRITTEN_OF_PROTOCOL
        require_replaceable("--out", [file for name in written for file in self.out.glob(name)], self.overwrite)
        return self._run_folders() if self.protocol.protocol is None else self._run_protocol(self.protocol.protocol)

    def _run_folders(self) -> int:
        """Evaluate all pairs with targets in the folders and print the table."""
        from pansplat import pipeline
        from pansplat.evaluation.report import evaluate, results_table

        if not self.paths:
            raise InputError("`pansplat evaluate` needs at least one folder of pairs, or --protocol")
        blend = parse_blend(self.blend or "deferred")
        lpips = choose_lpips(self.lpips, self._height)
        pairs = []
        for path in self.paths:
            found = pipeline.load_pairs(path, **vars(self.reading))
            if self.leave_one_out:
                with_targets = _leave_out_each(path, found)
            else:
                with_targets = [pair for pair in found if pair.targets]
                if not with_targets:
                    count = describe_count(len(found), "pair")
                    print(f"note: {path}: no target view in {count}; skipped", file=sys.stderr)
            pairs += with_targets
        predictor = pipeline.load_predictor(self.prediction)
        with progress_bar():
            cases = evaluate(
                pairs,
                predictor,
                self.out,
                height=self._height,
                refine_seconds=self.prediction.refine_seconds or 0.0,
                blend=blend,
                drawing=self.drawing,
                lpips=lpips,
            )
        make_table_console().print(results_table(cases))
        if lpips is not None:
            print(f"LPIPS is {lpips.name}")
        print(f"{self.out / 'results.json'} and the images of each case")
        return 0

    def _run_protocol(self, protocol: ProtocolName) -> int:
        """Run the protocol on the available data sets, print the tables and write the files."""
        from pansplat.evaluation.protocol import ProtocolOptions, run_protocol
        from pansplat.evaluation.tables import report_notes, rich_tables, write_report

        data = self._protocol_data()
        options = ProtocolOptions(self._height, self.protocol.limit, self.protocol.pictures)
        lpips = choose_lpips(self.lpips, self._height)
        methods = self._protocol_methods(protocol)
        with progress_bar():
            result = run_protocol(protocol, data, methods, self.out, options=options, lpips=lpips)
        written = write_report(result, self.out)
        console = make_table_console(_PROTOCOL_WIDTH)
        for table in rich_tables(result):
            console.print(table)
        for note in report_notes(result):
            console.print(note, markup=False, soft_wrap=True)
        print(f"{self.out / 'results.json'}, {written}")
        return 0

    def _protocol_data(self) -> Path:
        """The folder of data sets; refuses arguments that a protocol does not have."""
        if self.paths:
            raise InputError(
                f"--protocol takes its data from --data, got the folder {self.paths[0]} as well; leave it out"
            )
        if self.protocol.data is None:
            raise InputError("--protocol needs --data, the folder that holds the data sets")
        if self.blend not in (None, "joint", "deferred"):
            raise InputError(f"--blend must be joint or deferred with --protocol, got {self.blend!r}")
        for name in ("near", "far", "convention"):
            if getattr(self.reading, name) is not None:
                raise InputError(f"--{name} is set by the protocol; leave it out")
        return expand_home(self.protocol.data)

    def _protocol_methods(self, protocol: ProtocolName) -> list[Method]:
        """The methods of all predictors; a predictor with weights has the name of their file."""
        from pansplat import pipeline
        from pansplat.evaluation.protocol import list_methods
        from pansplat.model.weights import WEIGHTS_SUFFIXES

        blend = cast("Blend | None", self.blend)
        methods: list[Method] = []
        more = (
            # sweep has neither of the other options
            replace(self.prediction, model=name)
            if Path(name).suffix.lower() in WEIGHTS_SUFFIXES
            else PredictOptions(name)
            for name in self.protocol.models
        )
        for options in (self.prediction, *more):
            predictor = pipeline.load_predictor(options)
            methods += list_methods(predictor, protocol, blend, Path(options.model).stem, self.drawing)
        names = [method.name for method in methods]
        if len(set(names)) < len(names):
            raise InputError(f"--model and --models must have distinct names, got {', '.join(names)}; rename a file")
        return methods


def _leave_out_each(path: Path, pairs: Sequence[Pair]) -> list[Pair]:
    """A pair for each panorama of the tours of a folder that has others in its part; the rest are named."""
    from pansplat.tours.graph import find_tours
    from pansplat.tours.overlap import connect

    tours = find_tours(pairs)
    if not tours:
        raise InputError(
            f"{path}: --leave-one-out needed a tour of three or more panoramas with poses, got "
            f"{len({view.image for pair in pairs for view in pair.context})} panoramas; add some"
        )
    found = []
    for tour in map(connect, tours):
        alone = [n for n in range(len(tour)) if not tour.neighbours(n)]
        if alone:
            names = ", ".join(tour.panoramas[n].name for n in alone)
            print(f"note: {path}: not left out, because no other panorama shows the same: {names}", file=sys.stderr)
        found += [tour.leave_out(n) for n in range(len(tour)) if n not in alone]
    return found


def choose_lpips(choice: LpipsChoice, height: int) -> Lpips | None:
    """The chosen LPIPS; None for "none", or if "auto" finds no weights or the images are too small."""
    from pansplat.evaluation.lpips import MIN_IMAGE_SIZE, find_backbone, load_lpips

    if choice.lpips == "none":
        return None
    if choice.lpips != "auto":
        return load_lpips(cast("Backbone", choice.lpips), choice.lpips_weights)
    backbone = find_backbone(choice.lpips_weights) if height >= MIN_IMAGE_SIZE else None
    return load_lpips(backbone, choice.lpips_weights) if backbone else None
