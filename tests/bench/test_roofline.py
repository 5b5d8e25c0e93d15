"""The peaks' kernels do the arithmetic that is counted."""

import numpy as np

from pansplat.bench import roofline
from pansplat.bench.machine import describe_machine


def test_chains_do_every_multiply_add():
    # Twelve chains of v = v / 2 + 1 from v = 0 .. 11, each lane alike.
    values = np.arange(roofline._CHAINS, dtype=np.float64)
    for _ in range(5):
        values = values / 2 + 1
    assert roofline._chains(np.float32(0.5), 5) == np.float32(roofline._lanes() * values.sum())


def test_chains_stay_in_registers():
    roofline._chains(np.float32(0.5), 1)
    (code,) = roofline._chains.inspect_asm().values()
    lines = [line for line in code.splitlines() if "fmadd" in line or "fmla" in line]
    assert len(lines) >= roofline._CHAINS
    assert not [line for line in lines if "(%r" in line]


def test_triad_is_the_triad():
    a, b, c = (np.full(16, value, np.float32) for value in (0, 1, 2))
    roofline._triad(a, b, c)
    assert (a == 7).all()


def test_a_machine_is_described(monkeypatch):
    monkeypatch.setattr(roofline, "_STEPS", 1 << 10)
    monkeypatch.setattr(roofline, "_ELEMENTS", 1 << 12)
    machine = describe_machine(2)
    assert set(machine) >= {"cpu", "cores", "threads", "versions", "gpu", "fma_gflops", "bandwidth_gb_s"}
    for name in ("fma_gflops", "bandwidth_gb_s"):
        assert set(machine[name]) == {"1", "2"}
        assert all(value > 0 for value in machine[name].values())
    assert machine["versions"]["torch"]
