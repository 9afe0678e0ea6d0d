"""Encoding of states: any value survives, and any bytes raise RecordingError at most."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_journal import OPEN, JournalRig

from modelserver.errors import RecordingError
from modelserver.server.journal import encoding as journal_state

MOST_MEMORY = 40
"""Bytes of memory per byte of a state: an object, and its entries in two lists."""


class Value(NamedTuple):
    number: float
    numbers: tuple[float, ...]
    named: dict[str, tuple[int, ...]]
    text: str
    data: bytes
    next: Value | None = None


FLOATS = st.integers(0, (1 << 64) - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
INTS = st.integers(-(1 << 80), 1 << 80)
TEXTS = st.text(st.characters(), max_size=9)
VALUES = st.recursive(
    st.none(),
    lambda inner: st.builds(
        Value, FLOATS, st.lists(FLOATS, max_size=3).map(tuple),
        st.dictionaries(TEXTS, st.lists(INTS).map(tuple), max_size=3), TEXTS, st.binary(max_size=9), inner,
    ),
    max_leaves=4,
).filter(lambda value: value is not None)  # fmt: skip


@given(VALUES)
def test_given_any_value_then_it_is_read_back_to_the_same_bytes(value: Value) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal_state, "_list_installed", lambda: frozenset({__name__.partition(".")[0]}))
        data = journal_state.encode_value(value)
        back = journal_state.decode_value(data)
        assert repr(back) == repr(value)
        assert journal_state.encode_value(back) == data


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return an encoded run of the filter."""
    rig = JournalRig(Path(tmp_path_factory.mktemp("run")), OPEN)
    rig.drive(0.4)
    state = journal_state.detach(rig.loop.state)
    return journal_state.encode_run(journal_state.RunState(rig.vehicle.config, state))


def read(data: bytes) -> None:
    """Decode bytes that may be a run; only RecordingError may be raised, and memory stays in proportion."""
    tracemalloc.start()
    try:
        journal_state.decode_run(data)
    except RecordingError:
        pass
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 4_000_000 + MOST_MEMORY * len(data)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_given_bytes_of_a_run_that_were_changed_then_nothing_but_a_recording_error_comes_of_it(
    run: bytes, data: st.DataObject
) -> None:
    changed = bytearray(run)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(run) - 1))] = data.draw(st.integers(0, 255))
    read(bytes(changed))
    read(run[: data.draw(st.integers(0, len(run)))])


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_given_tokens_of_a_run_that_were_changed_then_nothing_but_a_recording_error_comes_of_it(
    run: bytes, data: st.DataObject
) -> None:
    # any of its blocks
    begin, (size,) = 0, struct.unpack_from(">I", run)
    for _ in range(data.draw(st.integers(0, 20))):
        if begin + 4 + size < len(run):
            begin += 4 + size
            (size,) = struct.unpack_from(">I", run, begin)
    tokens = msgspec.msgpack.decode(run[begin + 4 : begin + 4 + size])
    for _ in range(data.draw(st.integers(1, 4))):
        new = data.draw(st.one_of(st.none(), st.booleans(), INT64, FLOATS, TEXTS, st.binary(max_size=9)))
        tokens[data.draw(st.integers(0, len(tokens) - 1))] = new
    block = msgspec.msgpack.encode(tokens)
    read(run[:begin] + struct.pack(">I", len(block)) + block + run[begin + 4 + size :])


INT64 = st.integers(-(1 << 63), (1 << 64) - 1)


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_given_any_bytes_then_nothing_but_a_recording_error_comes_of_them(data: bytes) -> None:
    read(data)
    framed = struct.pack(">I", len(data)) + data
    with contextlib.suppress(RecordingError):
        journal_state.decode_value(framed)
