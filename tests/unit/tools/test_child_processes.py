"""A group of child processes: signals end it wherever they are handled."""

from __future__ import annotations

import signal
import sys
import weakref

import pytest

from mstools.launch.processes import ChildProcesses


class Thing:
    """Something that a callback can be attached to."""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_given_a_signal_in_a_callback_whose_exceptions_python_drops_then_the_next_check_ends_the_group(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals, code: int
) -> None:
    dropped: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: dropped.append(error.exc_value))
    before = signal.getsignal(number)

    def run_group() -> None:
        with ChildProcesses() as children:
            thing = Thing()
            reference = weakref.ref(thing, lambda _: signal.raise_signal(number))
            del thing
            assert (reference(), len(dropped)) == (None, 1)
            with pytest.raises(SystemExit) as caught:
                children.check()
            assert caught.value.code == code

    with pytest.raises(SystemExit) as ended:
        run_group()
    assert ended.value.code == code
    assert signal.getsignal(number) is before


def test_given_a_signal_whose_exception_python_makes_another_error_of_then_the_group_ends_by_the_signal() -> None:
    class Field:
        def __set_name__(self, owner: type, name: str) -> None:
            signal.raise_signal(signal.SIGTERM)

    def run_group() -> None:
        with ChildProcesses():
            type("Owner", (), {"field": Field()})

    with pytest.raises(SystemExit) as ended:
        run_group()
    assert ended.value.code == 143


def test_given_a_handler_of_ctrl_c_then_it_stays() -> None:
    def handle(*_: object) -> None:
        """Handle it."""

    before = signal.signal(signal.SIGINT, handle)
    try:
        with ChildProcesses():
            assert signal.getsignal(signal.SIGINT) is handle
    finally:
        assert signal.signal(signal.SIGINT, before) is handle
