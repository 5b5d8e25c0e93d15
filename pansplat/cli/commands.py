"""The commands' arguments: each dataclass is a subcommand, each field an argument, each docstring its help.

Only names and types live here; the work is imported when a command runs, so that `--help` does not wait for
torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

Out = Annotated[Path, arg(aliases=["-o"])]
Compat = Literal["trained", "official", "fixed"]
Precision = Literal["float32", "bfloat16"]
Drawing = Literal["exact", "original"]


@dataclass(frozen=True)
class PairChoice:
    """How to read a folder of panoramas, and which of its pairs to take."""

    pair: str | None = None
    """Name or number (from 1) of the pair, where the folder holds several; the first by default."""
    convention: str | None = None
    """Pose convention, where the folder does not tell: "cam2world opencv", "cam2world opengl",
    "world2cam opencv" or "world2cam opengl" (Habitat and Blender count as opengl)."""
    near: float | None = None
    """Nearest depth to search, metres; by default what the folder says."""
    far: float | None = None
    """Farthest depth to search, metres; by default what the folder says."""


@dataclass(frozen=True)
class Predict:
    """Predict the 3D Gaussians of a pair of panoramas and write them as a 3DGS .ply file."""

    path: Positional[Path]
    """Folder of the pair."""
    out: Out
    """The .ply file to write."""
    model: str = "sweep"
    """Predictor: `sweep`, which needs no weights, or a file of weights (.safetensors, or an original .ckpt)."""
    compat: Compat = "trained"
    """For a network: official computes what the original code does, fixed corrects its defects; by default as
    the weights were trained, so original ones as official."""
    precision: Precision = "float32"
    """Number type of a network's convolutions; bfloat16 is faster where the processor has it, and less exact."""
    height: int = 512
    """Panoramas are resized to this height, pixels. A network writes taller ones than 512 tile by tile, in
    bounded memory, and keeps none beside the pair."""
    degree: int | None = None
    """Highest degree of spherical harmonics to write, 0 to 4; by default all. The file of 4K panoramas is 5 GB with
    degree 4, 1 GB with 0."""
    min_opacity: float = 0.0
    """Leave out Gaussians of less opacity; below 0.004 they cannot be seen."""
    no_cache: bool = False
    """Predict anew even when the result is kept beside the pair."""
    choice: PairChoice = field(default_factory=PairChoice)

    def run(self) -> int:
        from pansplat.cli.scenes import run_predict

        return run_predict(self)


@dataclass(frozen=True)
class Render:
    """Render a scene, or a pair's prediction, to a picture (.png, .jpg, .webp, .exr) or a film (.mp4)."""

    path: Positional[Path]
    """A .ply scene, or the folder of a pair."""
    out: Out
    """The file to write; its suffix chooses the format."""
    at: float | None = None
    """Where to stand between the first (0) and the last (1) input camera; 0.5 by default."""
    pose: Path | None = None
    """File with the pose instead: a JSON matrix (cam2world, OpenCV axes, metres), 16 numbers, a KITTI or TUM
    trajectory, whose poses a film follows."""
    layout: Literal["equirect", "cubemap", "perspective"] | None = None
    """Panorama with one exact ray a pixel, panorama stitched from six faces, or a plain camera.
    By default equirect, for a film perspective."""
    height: int | None = None
    """Height of the picture, pixels; by default that of the input panoramas, for a film 360."""
    blend: str = "deferred"
    """deferred (each view's picture, weighted by nearness), joint (all at once), or view0, view1, ..."""
    fov: float = 90.0
    """Vertical field of view of `perspective`, degrees."""
    seconds: float = 4.0
    """Length of a film."""
    fps: float = 24.0
    """Pictures a second of a film."""
    model: str = "sweep"
    """Predictor, for a pair: `sweep`, or a file of weights."""
    compat: Compat = "trained"
    """For a network: official, fixed, or as its weights were trained; `pansplat predict --help` has more."""
    precision: Precision = "float32"
    """Number type of a network's convolutions."""
    predict_height: int = 512
    """Height the panoramas are resized to before the prediction, for a pair."""
    choice: PairChoice = field(default_factory=PairChoice)

    def run(self) -> int:
        from pansplat.cli.pictures import run_render

        return run_render(self)


@dataclass(frozen=True)
class LpipsChoice:
    """Whether to measure LPIPS, and with which weights."""

    lpips: Literal["auto", "vgg", "alex", "squeeze", "none"] = "auto"
    """Classifier that LPIPS asks; the paper's figures are vgg's. auto takes the first whose files are here, if any."""
    lpips_weights: Path | None = None
    """Folder of its weights; else that of the environment variable PANSPLAT_LPIPS, or the torch.hub cache."""


@dataclass(frozen=True)
class ProtocolChoice:
    """The paper's evaluations, instead of folders of pairs."""

    protocol: (
        Literal["m3d", "narrow", "replica", "residential", "360loc", "insta360", "ablation", "frame-distance"] | None
    ) = None
    """One table (or figure) of the paper, on whatever of its data is in --data; what is missing is named."""
    data: Path | None = None
    """Folder that holds the data sets, for --protocol: png_render_test_* or pano_grf/, 360Loc/, insta360/."""
    models: tuple[str, ...] = ()
    """More predictors that get rows in the table, for --protocol: `sweep`, or files of weights."""
    limit: int | None = None
    """At most this many cases of each test set, evenly spread; by default all, as in the paper."""
    pictures: int = 8
    """Of how many cases of each test set pictures are written."""


@dataclass(frozen=True)
class Evaluate:
    """Compare predictions with the real panoramas between the inputs, and with the cross-fade baseline.

    With --protocol: make a table of the paper, its rows and ours.
    """

    paths: Positional[tuple[Path, ...]]
    """Folders of pairs; those without target views are passed over. None with --protocol."""
    out: Out
    """Folder for results.json and, for each case, prediction.png, target.png and error.png."""
    model: str = "sweep"
    """Predictor: `sweep`, or a file of weights; always predicts anew, so that the times are true."""
    compat: Compat = "trained"
    """For a network: official, fixed, or as its weights were trained; `pansplat predict --help` has more."""
    precision: Precision = "float32"
    """Number type of a network's convolutions."""
    height: int = 512
    """Panoramas are resized to this height, pixels."""
    blend: str | None = None
    """deferred, joint, or view0, view1, ...; by default deferred, with --protocol what the paper's table shows."""
    drawing: Drawing = "exact"
    """exact, or original: as the original program draws, for the figures that were published of its weights."""
    convention: str | None = None
    """Pose convention, where a folder does not tell."""
    near: float | None = None
    """Nearest depth to search, metres."""
    far: float | None = None
    """Farthest depth to search, metres."""
    lpips: LpipsChoice = field(default_factory=LpipsChoice)
    protocol: ProtocolChoice = field(default_factory=ProtocolChoice)

    def run(self) -> int:
        if self.protocol.protocol is not None:
            from pansplat.cli.protocols import run_evaluate_protocol

            return run_evaluate_protocol(self)
        from pansplat.cli.reports import run_evaluate

        return run_evaluate(self)


@dataclass(frozen=True)
class Check:
    """Check that the poses of a pair fit its pictures; exit status 1 when a mistake is likely."""

    path: Positional[Path]
    """Folder of the pair."""
    choice: PairChoice = field(default_factory=PairChoice)

    def run(self) -> int:
        from pansplat.cli.reports import run_check

        return run_check(self)


@dataclass(frozen=True)
class Info:
    """Tell what a scene file holds: Gaussians by level and view, opacities, scales, bounds, cameras."""

    path: Positional[Path]
    """The .ply file."""

    def run(self) -> int:
        from pansplat.cli.reports import run_info

        return run_info(self)


@dataclass(frozen=True)
class Convert:
    """Convert a checkpoint of the original PanSplat (or its MVSplat baseline) to a file of weights.

    Nothing that the checkpoint holds is run. The weights are used with --model.
    """

    path: Positional[Path]
    """The original's Lightning checkpoint (.ckpt)."""
    out: Out
    """The .safetensors file to write."""

    def run(self) -> int:
        from pansplat.cli.convert import run_convert

        return run_convert(self)


SceneSource = Literal["prediction", "depth"]


@dataclass(frozen=True)
class BenchRaster:
    """Measure the rasterisers: time and memory against error, for every choice of kernel, order, filter and faces."""

    scene: Positional[Path | None] = None
    """A .ply scene, or the folder of a pair; by default a synthetic room, and the sample where it is there."""
    scene_from: SceneSource = "prediction"
    """How a pair becomes a scene: as `sweep` predicts it, or its depth maps with a Gaussian at every lattice point."""
    quick: bool = False
    """Some minutes on two cores instead of an hour: all choices at half the height only."""
    json: Path | None = None
    """File for the rows; it is written after every picture."""
    plot: Path | None = None
    """Picture of time against error (.png, .svg, .pdf); how the cost grows goes beside it, to NAME_sweeps."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Folder for raster.json, raster.md, raster.png and raster_sweeps.png."""
    height: int = 512
    """Height of the panoramas, pixels; a multiple of 8."""
    threads: int | None = None
    """The most threads to use; by default what torch uses."""

    def run(self) -> int:
        from pansplat.cli.bench import run_raster

        return run_raster(self)


@dataclass(frozen=True)
class BenchModel:
    """Measure the network: seconds of each part and memory against error, for each precision and way to run it."""

    model: Path | None = None
    """Weights of PanSplat (.safetensors); by default random ones, which take as long."""
    pair: Path | None = None
    """Folder of a pair; by default the sample, where it is there."""
    height: int = 512
    """Panoramas are resized to this height, pixels; a multiple of 64."""
    quick: bool = False
    """Precisions only, without tiles, single thread and the original's defects."""
    json: Path | None = None
    """File for the rows; it is written after every row."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Folder for model.json, model.md and model.png."""
    threads: int | None = None
    """The most threads to use; by default what torch uses."""

    def run(self) -> int:
        from pansplat.cli.bench_model import run_model

        return run_model(self)


@dataclass(frozen=True)
class BenchMemory:
    """Measure the memory of a training step and of a prediction over resolutions, for each way of backpropagation.

    Every row runs in a process of its own. With --out, the same command goes on with a run that was stopped.
    """

    preset: Literal["tiny", "small", "paper"] = "small"
    """Size of the network; weights are random."""
    heights: tuple[int, ...] = (128, 256, 512, 1024)
    """Of the panoramas, pixels; multiples of 32. Above 512 only the heads learn, as in the paper's stages."""
    quick: bool = False
    """Without one-step and 4 tiles."""
    limit_gb: float = 8.0
    """The most memory of a row, 10^9 bytes: one that would need more is not tried, one that takes more is ended."""
    style: Literal["panorama", "cubemap", "original"] = "cubemap"
    """How pictures are drawn; as in training's --memory.style."""
    perceptual: Literal["structure", "lpips-vgg", "lpips-alex", "lpips-squeeze"] = "structure"
    """Part of the loss; LPIPS needs its weights."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU where there is one, whose allocator then tells the memory."""
    threads: int | None = None
    """Threads to use; by default what torch uses."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Folder for memory.json, memory.md and memory.png."""

    def run(self) -> int:
        from pansplat.cli.bench_memory import run_memory

        return run_memory(self)


@dataclass(frozen=True)
class BenchMachine:
    """Measure what this machine could do at most: multiply-adds and memory bandwidth."""

    threads: int | None = None
    """The most threads to use; by default what torch uses."""

    def run(self) -> int:
        from pansplat.cli.bench import run_machine

        return run_machine(self)


@dataclass(frozen=True)
class Bench:
    """Measure speed, memory and error on this machine."""

    what: (
        Annotated[BenchRaster, subcommand("raster")]
        | Annotated[BenchModel, subcommand("model")]
        | Annotated[BenchMemory, subcommand("memory")]
        | Annotated[BenchMachine, subcommand("machine")]
    )

    def run(self) -> int:
        return self.what.run()


Command = (
    Annotated[Predict, subcommand("predict")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Check, subcommand("check")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Convert, subcommand("convert")]
)
