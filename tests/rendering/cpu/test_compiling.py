"""Kernels are compiled bare and kept; the user is told only when it takes long."""

import inspect

import numba as nb
import pytest

from pansplat.rendering.cpu import compiling
from pansplat.rendering.cpu.compiling import _stamp, announced, inlined, kernel


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
    [(0.0, "pansplat.rendering.cpu.observe", 1), (100.0, "pansplat.rendering.cpu.observe", 0), (0.0, "elsewhere", 0)],
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


def test_what_is_compiled_into_a_kernel_counts_for_its_freshness(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "__file__", str(tmp_path / "compiling.py"))
    package = compiling.__package__
    (tmp_path / "upper.py").write_text(f"from {package} import middle as m, other\n")
    (tmp_path / "middle.py").write_text(f"from {package}.lower import (\n    a,\n    b,\n)\n")
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 1\n")
    stamps = [_stamp(tmp_path / "upper.py")]
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 2\n")
        stamps.append(_stamp(tmp_path / "upper.py"))
    assert len(set(stamps[:3])) == 3 and stamps[2] == stamps[3]


def test_a_kernel_is_compiled_where_nothing_can_be_kept(monkeypatch):
    def refuse(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return nb.njit(**options)

    monkeypatch.setattr(compiling, "nb", type("Numba", (), {"njit": staticmethod(refuse)}))
    assert kernel(_work)(1.0) == 4.0
