"""Key files: the secrets with which commands are signed.

One key per line, `NAME HEX`; lines that begin with # are comments. The service accepts commands signed with any key of
its file, clients sign with the first of theirs. To replace a key, add the new one below the old one everywhere, then
move it to the top at the clients, then remove the old one.

A key file is rejected if another user can read it or replace it: by the mode and owner of the file, and of every folder
on its path. A file that systemd provides (LoadCredential) is trusted.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from pathlib import Path
from typing import Final

from modelserver.errors import KeyFileError, quote
from modelserver.files import open_regular
from modelserver.signing import MIN_KEY_BYTES, Key

MAX_BYTES: Final = 8192
MAX_KEYS: Final = 8
MAX_PATH_LENGTH: Final = 400
"""Characters of a path in a message."""

KEY_BYTES: Final = 32
"""Length of a generated key: the digest length of HMAC-SHA256."""

KEY_FILE_VARIABLE: Final = "MODELSERVER_KEY_FILE"
"""Environment variable with the clients' key file."""

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_HINT = "modelserver key new FILE makes one"


def read_keys(path: str | Path) -> tuple[Key, ...]:
    """Return the keys of a file, in its order; a systemd credential of the same name has priority.

    Raises KeyFileError, also if another user can read or replace the file.
    """
    path = Path(path)
    name = _show(path)
    credential = _find_credential(path.name)
    try:
        with open_regular(credential or path) as file:
            status = os.fstat(file.fileno())
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise KeyFileError(f"there is no key file {name}; {_HINT}") from None
    except OSError as error:
        raise KeyFileError(f"the key file {name} cannot be read: {error.strerror}") from None
    if credential is None:
        if status.st_mode & (stat.S_IRWXO | stat.S_IWGRP):
            mode = stat.S_IMODE(status.st_mode)
            raise KeyFileError(
                f"the key file {name} is open to others (mode {mode:04o}), so its keys are not secret: chmod 600 it, "
                "and make a new key if others use this machine"
            )
        if not _is_trusted(status.st_uid):
            raise KeyFileError(
                f"the key file {name} is owned by user {status.st_uid}, who can replace it; it was expected to be "
                f"root's or that of user {os.geteuid()}, who reads it: chown it, and make a new key if others use this "
                "machine"
            )
        _check_folders(path)
    return _parse_keys(raw, str(path))


def _show(path: object) -> str:
    return quote(str(path), MAX_PATH_LENGTH)


def _list_folders(path: Path) -> list[Path]:
    """Return the folders on the path of a file, as named and with links resolved; the outermost first."""
    named = Path(os.path.abspath(path))
    return list(dict.fromkeys([*reversed(named.parents), *reversed(named.resolve().parents)]))


def _check_folders(path: Path) -> None:
    """Raise KeyFileError if another user can replace a file in one of its folders."""
    for folder in _list_folders(path):
        try:
            status = folder.stat()
        except OSError:
            continue
        where = f"the key file {_show(path)} is reached by the folder {folder}"
        # in a folder with the sticky bit, such as /tmp, only its owner can replace a file
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            mode = stat.S_IMODE(status.st_mode)
            raise KeyFileError(f"{where}, which everyone may write (mode {mode:04o}): chmod o-w it, or use another one")
        if not _is_trusted(status.st_uid):
            raise KeyFileError(
                f"{where}, which is owned by user {status.st_uid}: it was expected to be root's or that of user "
                f"{os.geteuid()}, who reads the key; use a folder of either, e.g. /etc/modelserver"
            )


def _is_trusted(owner: int) -> bool:
    """Return whether only root and the user of this process can replace a file of this owner."""
    return owner in (0, os.geteuid()) or (owner == _UNMAPPED and _is_in_user_namespace())


_UNMAPPED: Final = 65534
"""Owner of a file of the host's root in a user namespace, e.g. of systemd (PrivateUsers=yes)."""


def _is_in_user_namespace() -> bool:
    """Return whether this process is in its own user namespace, in which the host's root is not mapped."""
    try:
        return Path("/proc/self/uid_map").read_text(encoding="ascii").split() != ["0", "0", "4294967295"]
    except OSError:
        return False


def _find_credential(name: str) -> Path | None:
    directory = os.environ.get("CREDENTIALS_DIRECTORY", "")
    found = Path(directory) / name
    return found if directory and name and found.is_file() else None


def _parse_keys(raw: bytes, path: str) -> tuple[Key, ...]:
    if len(raw) > MAX_BYTES:
        raise KeyFileError(f"{_show(path)} is longer than {MAX_BYTES} bytes and no key file")
    found: dict[str, Key] = {}
    for number, line in enumerate(raw.decode("utf-8", "replace").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        # no message quotes the line: it may be the secret
        where = f"{_show(path)} line {number}"
        name, _, secret = line.strip().partition(" ")
        try:
            key = Key(name, bytes.fromhex(secret.strip()))
        except ValueError:
            raise KeyFileError(f"{where}: a key is NAME HEX, a name and hexadecimal digits; {_HINT}") from None
        if not _NAME.fullmatch(name):
            raise KeyFileError(f"{where}: the name of a key has 1 to 64 letters, digits, dots, - and _")
        if len(key.secret) < MIN_KEY_BYTES:
            raise KeyFileError(
                f"{where}: a key of {len(key.secret)} bytes can be guessed; {MIN_KEY_BYTES} at least, {_HINT}"
            )
        if name in found:
            raise KeyFileError(f"{where}: the name is given twice")
        found[name] = key
    if not 1 <= len(found) <= MAX_KEYS:
        raise KeyFileError(f"{_show(path)} holds {len(found)} keys; 1 to {MAX_KEYS} are taken; {_HINT}")
    return tuple(found.values())


def generate_key(name: str = "") -> Key:
    """Generate a key of random bytes, named by its digest unless `name` is given. Raises KeyFileError."""
    secret = secrets.token_bytes(KEY_BYTES)
    name = name or f"key-{hashlib.sha256(secret).hexdigest()[:8]}"
    if not _NAME.fullmatch(name):
        raise KeyFileError(f"the name of a key has 1 to 64 letters, digits, dots, - and _, got {quote(name)}")
    return Key(name, secret)


def write_key(path: str | Path, key: Key) -> None:
    """Write a key file with mode 600.

    Raises KeyFileError if it exists, cannot be written, or another user could replace it.
    """
    _check_folders(Path(path))
    about = "# signs commands to a modelserver; keep it secret, and make another one for each vehicle"
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        raise KeyFileError(
            f"{_show(path)} exists already; its key may be in use. Remove it first, or name another file"
        ) from None
    except OSError as error:
        raise KeyFileError(f"{_show(path)} cannot be written: {error.strerror}") from None
    with open(handle, "w", encoding="utf-8") as file:
        file.write(f"{about}\n{key.name} {key.secret.hex()}\n")
        file.flush()
        os.fsync(file.fileno())
