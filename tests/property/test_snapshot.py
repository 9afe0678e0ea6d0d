"""The geometry snapshot: the published bytes load as the same model with the same revision."""

from __future__ import annotations

import json
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_formats import models

from modelserver.errors import WireError
from modelserver.formats.yaml_geometry import ModelSnapshot, decode_snapshot, encode_snapshot
from modelserver.geometry.model import Model
from modelserver.messages import SnapshotPart
from modelserver.wire.codec import SnapshotAssembler, split_snapshot


def snapshot(model: Model) -> ModelSnapshot:
    return ModelSnapshot("rover", model, "A:B", "C:D", 12.5, "ARM_JOINTS", 1500)


@pytest.mark.slow
@given(models())
@settings(max_examples=40, deadline=None)
def test_given_any_model_then_its_snapshot_is_of_the_same_revision(model: Model) -> None:
    again = decode_snapshot(encode_snapshot(snapshot(model)))
    assert again.model.revision == model.revision
    assert (again.vehicle, again.base_frame, again.rolling_frame) == ("rover", "A:B", "C:D")
    assert (again.history_s, again.joints_channel, again.joints_latency_us) == (12.5, "ARM_JOINTS", 1500)


@given(st.binary(max_size=5000), st.randoms(use_true_random=False))
def test_given_parts_in_any_order_and_twice_then_the_snapshot_is_assembled(data: bytes, random: object) -> None:
    parts: list[SnapshotPart] = split_snapshot(data or b"x", "0" * 16, 1)
    shuffled = [*parts, *parts]
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assembler = SnapshotAssembler()
    wholes = [whole for whole in map(assembler.add, shuffled) if whole is not None]
    assert wholes
    assert set(wholes) == {data or b"x"}


@given(st.binary(max_size=200))
def test_given_bytes_that_are_no_snapshot_then_it_is_rejected(data: bytes) -> None:
    for damaged in (data, zlib.compress(data), zlib.compress(json.dumps({"geometry": data.hex()}).encode())):
        with pytest.raises(WireError):
            decode_snapshot(damaged)
