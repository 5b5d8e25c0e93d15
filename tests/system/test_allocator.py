import ctypes
import subprocess
import sys

import pytest

_PROGRAM = """
import ctypes, threading
import numpy as np
from pansplat.system.allocator import keep_freed_memory

library = ctypes.CDLL(None)
library.mallinfo2.restype = type("Info", (ctypes.Structure,), {"_fields_": [("numbers", ctypes.c_size_t * 10)]})

def count_mapped():
    before = library.mallinfo2().numbers[3]
    array = np.ones(1 << 24)  # 128 MB
    counts.append(library.mallinfo2().numbers[3] - before)

counts = []
count_mapped()
keep_freed_memory()
count_mapped()
thread = threading.Thread(target=count_mapped)
thread.start()
thread.join()
print(*counts)
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="glibc from 2.33 on"
)
def test_large_arrays_are_taken_from_memory_that_the_process_keeps() -> None:
    output = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True).stdout
    assert output.split() == ["1", "0", "0"]  # arrays that the system has mapped: before, afterwards, in another thread
