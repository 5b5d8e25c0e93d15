"""Kernels are compiled bare and kept; the user is told only when it takes long."""

import inspect

import numba as nb
import pytest

from pansplat.render.cpu import compiling
from pansplat.render.cpu.compiling import announced, inlined, kernel


def _work(x):
    for i in range(3):
        x += i
    return x


def _compile(module):
    function = type(_work)(_work.__code__, {"range": range})
    function.__module__ = module
    nb.njit(function)(1.0)


@pytest.mark.parametrize(
    ("patience", "module", "lines"),
    [(0.0, "pansplat.render.cpu.observe", 1), (100.0, "pansplat.render.cpu.observe", 0), (0.0, "elsewhere", 0)],
)
def test_compiling_our_kernels_is_announced_when_it_takes_long(patience, module, lines, monkeypatch, capsys):
    monkeypatch.setattr(compiling, "_PATIENCE", patience)
    monkeypatch.setattr(compiling, "_told", False)
    with announced():
        _compile(module)
        _compile(module)  # one after another is still one wait
    assert capsys.readouterr().err.count("compiling the rasteriser for this processor") == lines


@pytest.mark.parametrize("decorate", [kernel, inlined])
def test_a_wrapped_function_is_compiled_bare(decorate):
    def wrapper(*args):
        raise AssertionError

    wrapper.__wrapped__ = _work
    compiled = decorate(wrapper)
    assert compiled.py_func is _work and inspect.isfunction(compiled.py_func)
