"""Where Triton's kernels run in tests: on CUDA, or interpreted on the CPU where there is none."""

import os
import sys

import pytest
import torch

if not torch.cuda.is_available():
    if "triton" in sys.modules and "TRITON_INTERPRET" not in os.environ:
        pytest.skip("needs CUDA, or TRITON_INTERPRET=1 from the start", allow_module_level=True)
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
