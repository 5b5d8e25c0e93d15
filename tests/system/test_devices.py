"""Where work runs, with pretended graphics cards: the choice, what a card lacks, and a card whose memory is full."""

import sys
import types

import pytest
import torch
from refusals import expect_error

from pansplat.errors import InputWarning
from pansplat.system import devices
from pansplat.system.devices import choose_device, describe_devices, use_device, with_device


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A card that torch can use, with Triton."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Card 9000")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setitem(sys.modules, "triton", types.SimpleNamespace(__version__="3.6.0"))
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", torch.backends.cudnn.allow_tf32)  # is restored
    return monkeypatch


@pytest.fixture
def no_card(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def choose(choice: devices.Device, *arguments: object, **options: object) -> str:
    with use_device(choice):
        return choose_device("work", *arguments, **options).type  # type: ignore[arg-type]


@pytest.mark.usefixtures("no_card")
def test_without_a_card_all_work_is_the_processors_and_cuda_is_refused() -> None:
    assert choose("auto") == choose("cpu") == "cpu"
    expect_error("`device` cuda needs a graphics card that torch can use, got none", choose, "cuda")
    assert "all work runs on the processor" in "\n".join(describe_devices())
    expect_error("`device` must be one of auto, cpu, cuda, got 'gpu'", choose, "gpu")


@pytest.mark.usefixtures("card")
def test_a_card_has_long_work_and_all_that_is_given_to_it() -> None:
    assert choose("auto", 60.0) == choose("cuda", 0.1) == choose("auto", kernels=True) == "cuda"
    assert choose("auto", 0.1) == choose("cpu", 60.0) == "cpu"
    assert not torch.backends.cudnn.allow_tf32


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("triton", None, "needs the package triton 3.2 or newer, which is not installed"),
        ("triton", types.SimpleNamespace(__version__="2.1.0"), "which has version 2.1"),
        ("capability", (7, 5), "compute capability 8.0 or newer, got 7.5"),
    ],
)
def test_a_card_that_lacks_something_has_networks_and_one_sentence(card, name, value, problem) -> None:
    if name == "triton":
        card.setitem(sys.modules, name, value)
    else:
        card.setattr(torch.cuda, "get_device_capability", lambda: value)
    for choice in ("auto", "cuda"):
        with pytest.warns(InputWarning, match=f"refinement and films run on the processor: .*{problem}") as notes:
            assert choose(choice, kernels=True) == "cpu"
        assert len(notes) == 1 and choose(choice) == "cuda"
    assert choose("cpu", kernels=True) == "cpu", "without a sentence"
    text = "\n".join(describe_devices())
    assert "on Card 9000: networks of --model" in text and problem in text


@pytest.mark.usefixtures("card")
def test_a_choice_counts_for_what_is_called_inside_and_each_work_is_said() -> None:
    said: list[str] = []

    @with_device
    def work(seconds: float) -> str:
        return choose_device("fit", seconds).type

    with use_device("cpu", said.append):
        assert (work(60.0), work(60.0, device="cuda"), work(60.0)) == ("cpu", "cuda", "cpu")
        assert work(0.1, device="auto") == "cpu"
    assert work(60.0) == "cuda"
    assert said[:2] == ["fit: on the processor", "fit: on Card 9000"]
    assert said[3:] == ["fit: on the processor, which is faster for short work"]
