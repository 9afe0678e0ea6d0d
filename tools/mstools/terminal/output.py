"""Printing for people, and writing files whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from typing import TextIO

import typer

from modelserver.errors import ModelServerError, Problem
from modelserver.geometry.model import Model


def safe(text: str) -> str:
    """Return `text` with control characters escaped: what comes from a file must not steer the terminal."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def print_problem(problem: Problem, err: bool = False) -> None:
    """Print a problem as compilers do, `file:line: severity: message`, with the rest indented below."""
    place = f"{problem.file}:{problem.line}" if problem.line else problem.file
    typer.echo(safe(f"{place}: {problem.severity}: {problem.message}" if place else str(problem)), err=err)
    for name, value in (("in", problem.element), ("fix", problem.fix), ("nearest", ", ".join(problem.nearest))):
        if value:
            typer.echo(f"    {name + ':':<9}{safe(value)}", err=err)


def counted(count: int, one: str, several: str = "") -> str:
    """Return e.g. `1 body`, `3 bodies`."""
    return f"{count} {one if count == 1 else several or one + 's'}"


def size_of(model: Model) -> str:
    """Return how many of what a model holds."""
    frames = sum(len(body.frames) for body in model.bodies)
    return ", ".join(
        (
            counted(len(model.bodies), "body", "bodies"),
            counted(frames, "frame"),
            counted(len(model.constraints), "constraint"),
        )
    )


def check_target(path: str) -> None:
    """Raise what `written_whole` would where a file cannot be written: to be asked before work that takes a while.

    A file that exists is no objection; empty and - (standard output) name no file.
    """
    if path in ("", "-"):
        return
    target = os.path.realpath(path)
    if os.path.isdir(target):
        raise ModelServerError(f"{safe(path)} is a directory; name a file in it")
    if os.path.exists(target) and not os.path.isfile(target):
        return
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        raise ModelServerError(f"{safe(path)} cannot be written: there is no folder {safe(folder)}; make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ModelServerError(f"{safe(path)} cannot be written: nothing may be written in the folder {safe(folder)}")


def write_file(path: str, text: str, replace: bool) -> None:
    """Write a file so that it is there whole or not at all; as `written_whole`."""
    with written_whole(path, replace) as stream:
        stream.write(text)


@contextlib.contextmanager
def written_whole(path: str, replace: bool) -> Iterator[TextIO]:
    """Give a stream to write; the file is there, whole, when the block has ended well, and else as it was.

    What is no regular file (a device, a pipe) is written to as it is. Raises ModelServerError where the file exists
    and `replace` is false, OSError where it cannot be written.
    """
    target = os.path.realpath(path)
    if os.path.isdir(target):
        raise ModelServerError(f"{safe(path)} is a directory; name a file in it")
    if os.path.exists(target) and not os.path.isfile(target):
        with open(target, "w", encoding="utf-8", newline="\n") as stream:
            yield stream
        return
    if os.path.lexists(target):
        if not replace:
            raise _exists(path)
        mode = os.stat(target).st_mode & 0o777
    else:
        umask = os.umask(0)
        os.umask(umask)
        mode = 0o666 & ~umask
    try:
        handle, draft = tempfile.mkstemp(prefix=".", suffix=".part", dir=os.path.dirname(target))
    except OSError as error:
        # the draft's name says nothing to who asked for the file
        raise OSError(error.errno, error.strerror, path) from None
    try:
        with open(handle, "w", encoding="utf-8", newline="\n") as stream:
            yield stream
            stream.flush()
            os.fchmod(stream.fileno(), mode)
            os.fsync(stream.fileno())
        if replace:
            os.replace(draft, target)
        else:
            try:
                # a link is made only where nothing is: what came into being meanwhile is not lost
                os.link(draft, target)
            except FileExistsError:
                raise _exists(path) from None
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(draft)


def _exists(path: str) -> ModelServerError:
    return ModelServerError(f"{safe(path)} exists already; give --force to replace it, or another name")
