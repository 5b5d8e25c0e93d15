"""A pretended graphics card: tensors on "meta" that hold numbers in main memory, and a count of what moves."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

CARD = torch.device("meta")  # torch's functions accept it on every machine
_TENSOR, _AUTOCAST = torch.tensor, torch.autocast
_READS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::_unique2")  # results whose size or value is read


class _CardTensor(Tensor):
    """A tensor of the card; `inner` holds its numbers."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "_CardTensor":
        made = Tensor._make_wrapper_subclass(
            cls, inner.shape, inner.stride(), inner.storage_offset(), dtype=inner.dtype, device=CARD
        )
        made.inner = inner
        return made

    def __getitem__(self, index: Any) -> Tensor:
        """The part; a list of indices, from which "meta" makes no numbers, is copied as to a card."""
        parts = index if isinstance(index, tuple) else (index,)
        return super().__getitem__(tuple(_TENSOR(part) if isinstance(part, list) else part for part in parts))

    def tolist(self) -> Any:
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{function} of a tensor of the card outside of the block")


class _Card(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def make_constant(self, value: Any, **options: Any) -> Tensor:
        """`torch.tensor` or `as_tensor`, which makes tensors of the card without a dispatch mode."""
        if isinstance(value, Tensor):
            return value.to(**options)
        device = options.pop("device", None) or "cpu"
        made = _TENSOR(value, **options)
        if torch.device(device) != CARD:
            return made.to(device)
        self.count.update(constants=1, copies=-1)
        return made.to(CARD)

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        values = (*args, *kwargs.values())
        tensors = [v for value in values for v in _list_parts(value) if isinstance(v, Tensor)]
        on_card = [isinstance(value, _CardTensor) for value in tensors]
        target = kwargs.get("device")
        if target is None and not any(on_card):
            return function(*args, **kwargs)
        if target is not None:
            kwargs["device"] = torch.device("cpu")
        to_card = any(on_card) if target is None else torch.device(target) == CARD
        name = function._schema.name
        if tensors and (name in ("aten::_to_copy", "aten::copy_")) and (len({*on_card, to_card}) > 1):
            self.count["copies"] += 1
        elif any(on_card) and any(value.ndim and not card for value, card in zip(tensors, on_card, strict=True)):
            self.count["copies" if name.startswith("aten::index") else f"mixed in {name}"] += 1
        self.count["reads"] += any(on_card) and name in _READS
        got = function(*map(_unwrap, args), **{key: _unwrap(value) for key, value in kwargs.items()})
        known = {id(value.inner): value for value in tensors if isinstance(value, _CardTensor)}
        return _wrap(got, known) if to_card else got


def _list_parts(value: Any) -> Any:
    return value if isinstance(value, (list, tuple)) else (value,)


def _unwrap(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_unwrap(part) for part in value]
    return value.inner if isinstance(value, _CardTensor) else value


def _wrap(got: Any, known: dict[int, Tensor]) -> Any:
    """Results on the card; one that is an argument is that argument."""
    if isinstance(got, (list, tuple)):
        return type(got)([_wrap(part, known) for part in got])
    return (known[id(got)] if id(got) in known else _CardTensor(got)) if isinstance(got, Tensor) else got


@contextmanager
def pretend_card() -> Iterator[Counter[str]]:
    """A block in which `CARD` holds numbers.

    Yields:
        Counts of `copies` between card and main memory, of `constants` that are made on the card, of `reads` of single
        numbers from there, and of operations on tensors of both, which fail on a card.
    """
    card = _Card()
    replaced = {
        "tensor": card.make_constant,
        "as_tensor": card.make_constant,
        "autocast": lambda _, *args, **kwargs: _AUTOCAST("cpu", *args, **kwargs),  # "meta" has none
        "is_autocast_enabled": lambda _: False,
    }
    with mock.patch.multiple(torch, **replaced), card:
        yield card.count
