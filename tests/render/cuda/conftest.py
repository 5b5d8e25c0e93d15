"""Triton's interpreter, chosen before the kernels are imported."""

import os

os.environ["TRITON_INTERPRET"] = "1"
