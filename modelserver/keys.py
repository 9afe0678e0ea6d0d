"""Key files: where the secrets lie that commands are signed with.

A line for each key, `NAME HEX`; lines that begin with # are comments. The service takes what was signed with any of
them, clients sign with the first. So a new key is added below the old one everywhere, then put first at the clients,
and last the old one is removed.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from pathlib import Path
from typing import Final

from modelserver.errors import KeyFileError, shown
from modelserver.regular_files import open_regular
from modelserver.signing import SHORTEST_KEY, Key

MAX_BYTES: Final = 8192
MAX_KEYS: Final = 8
LONGEST_PATH: Final = 400
"""Characters of a path in a message: it is the administrator's own."""

KEY_BYTES: Final = 32
"""Of a key that is made here: as many as HMAC-SHA256 makes use of."""

ENVIRONMENT: Final = "MODELSERVER_KEY_FILE"
"""Where clients look for the name of the key file."""

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_MAKE = "modelserver key new FILE makes one"


def read_keys(path: str | Path) -> tuple[Key, ...]:
    """Return the keys of a file, in its order. Raises KeyFileError, also where others may read or replace it.

    Where systemd hands a file of that name over (LoadCredential), that one is read.
    """
    path = Path(path)
    handed = _credential(path.name)
    try:
        with open_regular(handed or path) as file:
            status = os.fstat(file.fileno())
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise KeyFileError(f"there is no key file {shown(str(path), LONGEST_PATH)}; {_MAKE}") from None
    except OSError as error:
        raise KeyFileError(f"the key file {shown(str(path), LONGEST_PATH)} cannot be read: {error.strerror}") from None
    # what systemd hands over lies in a directory that nobody else may enter
    if handed is None:
        if status.st_mode & (stat.S_IRWXO | stat.S_IWGRP):
            mode = stat.S_IMODE(status.st_mode)
            raise KeyFileError(
                f"the key file {shown(str(path), LONGEST_PATH)} is open to others (mode {mode:04o}), so its keys are "
                "secret no more: chmod 600 it, and make a new key if others use this machine"
            )
        if not _is_trusted(status.st_uid):
            raise KeyFileError(
                f"the key file {shown(str(path), LONGEST_PATH)} is owned by user {status.st_uid}, who can replace it; "
                f"it was expected to be root's or that of user {os.geteuid()}, who reads it: chown it, and make a new "
                "key if others use this machine"
            )
        _check_folders(path)
    return _parsed(raw, str(path))


def shared_folder(path: str | Path) -> str:
    """Return a folder on the way to a file that its group may write, empty where there is none.

    Whoever is in the group can put another file in the place of this one. Raises OSError.
    """
    for folder in _folders(Path(path)):
        mode = folder.stat().st_mode
        if mode & stat.S_IWGRP and not mode & stat.S_ISVTX:
            return str(folder)
    return ""


def _folders(path: Path) -> list[Path]:
    """Return the folders on the way to a file, as it is named and where links lead; the outermost first."""
    named = Path(os.path.abspath(path))
    return list(dict.fromkeys([*reversed(named.parents), *reversed(named.resolve().parents)]))


def _check_folders(path: Path) -> None:
    """Raise KeyFileError where another user can put another file in the place of one."""
    for folder in _folders(path):
        try:
            status = folder.stat()
        except OSError:
            continue  # whoever cannot look at it cannot judge it either
        where = f"the key file {shown(str(path), LONGEST_PATH)} is reached by the folder {folder}"
        # in a folder with the sticky bit, such as /tmp, files can be replaced by their owners alone
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            mode = stat.S_IMODE(status.st_mode)
            raise KeyFileError(f"{where}, which everyone may write (mode {mode:04o}): chmod o-w it, or use another one")
        if not _is_trusted(status.st_uid):
            raise KeyFileError(
                f"{where}, which is owned by user {status.st_uid}: it was expected to be root's or that of user "
                f"{os.geteuid()}, who reads the key; use a folder of either, e.g. /etc/modelserver"
            )


def _is_trusted(owner: int) -> bool:
    """Return whether a file of this owner can be replaced by nobody but root and the user of this process."""
    return owner in (0, os.geteuid()) or (owner == _UNMAPPED and _has_own_users())


_UNMAPPED: Final = 65534
"""The owner that a file of the host's root has in a user namespace, as systemd makes one (PrivateUsers=yes)."""


def _has_own_users() -> bool:
    """Return whether this process is in a user namespace of its own, where the host's root has no number."""
    try:
        return Path("/proc/self/uid_map").read_text(encoding="ascii").split() != ["0", "0", "4294967295"]
    except OSError:
        return False


def _credential(name: str) -> Path | None:
    directory = os.environ.get("CREDENTIALS_DIRECTORY", "")
    found = Path(directory) / name
    return found if directory and name and found.is_file() else None


def _parsed(raw: bytes, path: str) -> tuple[Key, ...]:
    if len(raw) > MAX_BYTES:
        raise KeyFileError(f"{shown(path, LONGEST_PATH)} is longer than {MAX_BYTES} bytes and no key file")
    found: dict[str, Key] = {}
    for number, line in enumerate(raw.decode("utf-8", "replace").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        # nothing of a line is repeated in a message: it may be the secret
        where = f"{shown(path, LONGEST_PATH)} line {number}"
        name, _, secret = line.strip().partition(" ")
        try:
            key = Key(name, bytes.fromhex(secret.strip()))
        except ValueError:
            raise KeyFileError(f"{where}: a key is NAME HEX, a name and hexadecimal digits; {_MAKE}") from None
        if not _NAME.fullmatch(name):
            raise KeyFileError(f"{where}: the name of a key has 1 to 64 letters, digits, dots, - and _")
        if len(key.secret) < SHORTEST_KEY:
            raise KeyFileError(
                f"{where}: a key of {len(key.secret)} bytes can be guessed; {SHORTEST_KEY} at least, {_MAKE}"
            )
        if name in found:
            raise KeyFileError(f"{where}: the name is given twice")
        found[name] = key
    if not 1 <= len(found) <= MAX_KEYS:
        raise KeyFileError(f"{shown(path, LONGEST_PATH)} holds {len(found)} keys; 1 to {MAX_KEYS} are taken; {_MAKE}")
    return tuple(found.values())


def new_key(name: str = "") -> Key:
    """Return a key of random bytes; without a name it is called after its own digest. Raises KeyFileError."""
    secret = secrets.token_bytes(KEY_BYTES)
    name = name or f"key-{hashlib.sha256(secret).hexdigest()[:8]}"
    if not _NAME.fullmatch(name):
        raise KeyFileError(f"the name of a key has 1 to 64 letters, digits, dots, - and _, got {shown(name)}")
    return Key(name, secret)


def write_key(path: str | Path, key: Key) -> None:
    """Write a key file that nobody else may read.

    Raises KeyFileError where it exists, cannot be written, or another user could replace it.
    """
    _check_folders(Path(path))
    about = "# signs commands to a modelserver; keep it secret, and make another one for each vehicle"
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        raise KeyFileError(
            f"{shown(str(path), LONGEST_PATH)} exists already; its key may be in use. Remove it first, or name "
            "another file"
        ) from None
    except OSError as error:
        raise KeyFileError(f"{shown(str(path), LONGEST_PATH)} cannot be written: {error.strerror}") from None
    with open(handle, "w", encoding="utf-8") as file:
        file.write(f"{about}\n{key.name} {key.secret.hex()}\n")
        file.flush()
        os.fsync(file.fileno())
