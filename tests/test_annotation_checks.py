"""The run-time checks of annotations themselves."""

from __future__ import annotations

import pytest
import torch
from annotation_checks import check_types, restart_checks
from jaxtyping import Float, TypeCheckError, jaxtyped
from torch import Tensor


@jaxtyped(typechecker=check_types)
def _transpose(matrix: Float[Tensor, "rows columns"]) -> Float[Tensor, "columns rows"]:
    return matrix.clone()  # wrong unless the matrix is square


def test_the_first_calls_after_a_restart_are_checked() -> None:
    for _ in range(2):
        with pytest.raises(TypeCheckError, match="return value"):
            _transpose(torch.zeros(2, 3))
        with pytest.raises(TypeCheckError, match="parameters"):
            _transpose(torch.zeros(2))
        for _ in range(200):
            _transpose(torch.zeros(2, 2))
        assert _transpose(torch.zeros(2, 3)).shape == (2, 3)  # later calls are not
        restart_checks()
