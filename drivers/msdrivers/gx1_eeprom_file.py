"""The EEPROM of an emulated 3DM-GX1 in a file, so that it survives a restart of the emulator.

The file is text: a word on each line, its address and its value in decimal.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from modelserver.errors import ModelServerError, quote
from modelserver.files.regular import read_regular
from msdrivers.emulate.gx1 import Eeprom

MAX_EEPROM_FILE_BYTES = 1 << 16
"""The EEPROM has 128 words; a larger file is rejected."""

_WORD_LINE = re.compile(r"\s*([0-9]{1,9})\s+([0-9]{1,9})\s*", re.ASCII)


def read_eeprom(path: Path) -> Eeprom:
    """Return the memory in a file, that of a new device where there is none.

    Raises ModelServerError for a file that holds something else, OSError for one that cannot be read.
    """
    try:
        text = read_regular(path, MAX_EEPROM_FILE_BYTES).decode("ascii", errors="replace")
    except FileNotFoundError:
        return Eeprom.make_factory()
    words: dict[int, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        found = _WORD_LINE.fullmatch(line)
        address, value = map(int, found.groups()) if found else (-1, 0)
        if address % 2 or address > 254 or value > 0xFFFF:
            raise ModelServerError(
                f"{path}, line {number}: {quote(line, 40)} is no EEPROM word (an even address up to 254 and a value up "
                "to 65535); give the file that an emulator has written, or one that is not there yet"
            )
        words[address] = value
    return Eeprom().write(words)


def write_eeprom(path: Path, eeprom: Eeprom) -> None:
    """Write the memory to a file, which is whole at any time. Raises OSError."""
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as draft:
        new = Path(draft) / path.name
        new.write_text("".join(f"{2 * n} {word}\n" for n, word in enumerate(eeprom.words)), encoding="ascii")
        os.replace(new, path)
