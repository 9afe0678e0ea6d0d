"""The memory of an emulated 3DM-GX1 in a file, so that it outlives the emulator as the device's outlives its power.

The file is text: a word on each line, its address and its value in decimal.
"""

from __future__ import annotations

import os
from pathlib import Path

from modelserver.errors import ModelServerError, shown
from modelserver.regular_files import read_regular
from msdrivers.emulate.gx1_unit import Eeprom

MAX_BYTES = 1 << 16
"""The memory has 128 words; more is another file."""


def read_eeprom(path: Path) -> Eeprom:
    """Return the memory in a file, that of a new device where there is none.

    Raises ModelServerError for a file that holds something else, OSError for one that cannot be read.
    """
    try:
        text = read_regular(path, MAX_BYTES).decode("ascii", errors="replace")
    except FileNotFoundError:
        return Eeprom.factory()
    words: dict[int, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.split()
        if len(fields) != 2 or not all(field.isascii() and field.isdecimal() for field in fields):
            raise _wrong(path, number, line)
        address, value = map(int, fields)
        if address % 2 or address > 254 or value > 0xFFFF:
            raise _wrong(path, number, line)
        words[address] = value
    return Eeprom().written(words)


def write_eeprom(path: Path, eeprom: Eeprom) -> None:
    """Write the memory to a file, which is whole at any time. Raises OSError."""
    beside = path.with_name(f"{path.name}.new")
    beside.write_text("".join(f"{2 * n} {word}\n" for n, word in enumerate(eeprom.words)), encoding="ascii")
    os.replace(beside, path)


def _wrong(path: Path, number: int, line: str) -> ModelServerError:
    return ModelServerError(
        f"{path}, line {number}: {shown(line, 40)} is no word of a memory (an even address up to 254 and a value up to "
        "65535); give the file that an emulator has written, or one that is not there yet"
    )
