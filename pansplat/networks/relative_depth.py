"""A user's network of relative depth, as an ONNX file, such as an export of Depth Anything V2.

Convention: one input (1, 3, h, w), float32, RGB normalised by the mean and deviation of ImageNet; one output (1, h, w),
inverse depth along the optical axis up to a scale and a shift of each image. The file contains its weights.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.system.files import expand_home, read_file

_DEFAULT_SIZE = 518  # rows of the input of networks that take any size; 14 divides it
_NEEDED = (
    "a network with one float32 image (1, 3, h, w) as its input and relative inverse depth (1, h, w) as its output"
)
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # mean and deviation of ImageNet's colours


class RelativeDepthNetwork:
    """A network of relative inverse depth.

    Args:
        session: an `onnxruntime.InferenceSession`, or an object with its `get_inputs` and `run`.
        name: name of the file, for messages.
        fingerprint: changes with the file.

    Raises:
        InputError: the network has other inputs.
    """

    def __init__(self, session: Any, name: str, fingerprint: str) -> None:
        self._session, self._name, self.fingerprint = session, name, fingerprint
        inputs = session.get_inputs()
        sizes = [size if isinstance(size, int) and size > 0 else None for each in inputs for size in each.shape]
        is_image = len(sizes) == 4 and sizes[0] in (1, None) and sizes[1] in (3, None)
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or not is_image:
            described = (f"{each.name} {each.type} {list(each.shape)}" for each in inputs)
            raise self._refuse(f"inputs {', '.join(described)}")
        self.size = sizes[2] or sizes[3] or _DEFAULT_SIZE, sizes[3] or sizes[2] or _DEFAULT_SIZE
        """Height and width of its images, pixels."""
        self._input = inputs[0].name

    def __call__(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "height width"]:
        """Relative inverse depth of an image of `size`, RGB in [0, 1]."""
        mean, deviation = (torch.tensor(each)[:, None, None] for each in (_MEAN, _DEVIATION))
        normalised = ((image.float() - mean) / deviation)[None].contiguous().numpy()
        try:
            outputs = self._session.run(None, {self._input: normalised})
        except Exception as error:  # onnxruntime has no class of its own for them
            raise self._refuse(f"'{_first_line(error)}' for an image of {self.size[0]}x{self.size[1]}") from error
        if len(outputs) != 1 or np.ndim(outputs[0]) != 3 or len(outputs[0]) != 1:
            raise self._refuse(f"outputs of shapes {', '.join(str(np.shape(output)) for output in outputs)}")
        relative = torch.from_numpy(np.asarray(outputs[0][0], np.float32))
        if not torch.isfinite(relative).all():
            raise self._refuse("NaN or infinity in its output")
        return relative

    def estimate(self, images: Float[Tensor, "crop 3 h w"]) -> list[Float[Tensor, "height width"]]:
        """Relative inverse depth of the crops of a panorama, RGB in [0, 1].

        Raises:
            InputError: no crop has any depth.
        """
        found = [self(image) for image in images]
        if all(relative.max() - relative.min() <= 1e-6 * relative.abs().max() for relative in found):
            raise self._refuse("one constant value for every image")
        return found

    def _refuse(self, got: str) -> InputError:
        return InputError(
            f"{self._name}: needed {_NEEDED}, got {got}; export the network again (docs/depth_network.md)."
        )


def load_relative_depth(path: Path | str) -> RelativeDepthNetwork:
    """The network of an ONNX file, which runs on the processor.

    Raises:
        InputError: the file is no such network, or onnxruntime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(
            f"{path}: needed onnxruntime to run a depth network, got no such package; install it "
            "(pip install 'pansplat[onnx]', or pip install onnxruntime)."
        ) from error
    content = read_file(expand_home(path), "an ONNX file")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no class of its own for them
        raise InputError(
            f"{path}: needed an ONNX network that contains its weights, got '{_first_line(error)}'; export it again, "
            "with the weights in the file."
        ) from error
    return RelativeDepthNetwork(session, str(path), hashlib.blake2b(content, digest_size=8).hexdigest())


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
