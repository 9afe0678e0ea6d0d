"""Output of commands: text, tables, problems of the input, atomically written files, progress, and live displays."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import IntEnum
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Final, TextIO

import typer

from modelserver.errors import (
    ConfigError,
    GeometryError,
    Location,
    ModelServerError,
    Problem,
    Severity,
    find_nearest_names,
)
from modelserver.extras import is_installed, make_install_command
from modelserver.files import check_links
from modelserver.geometry.model import Model

if TYPE_CHECKING:
    from rich.live import Live

    from modelserver.wire.eventlog import LogEvent, LogFile


def escape(text: str) -> str:
    """Escape control characters: text from a file or the bus must not control the terminal."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def print_problems(problems: Iterable[Problem], err: bool = True) -> None:
    """Print problems as `file:line: severity: message`, with element, fix and suggestions indented below."""
    for each in problems:
        place = f"{each.file}:{each.line}" if each.line else each.file
        typer.echo(escape(f"{place}: {each.severity}: {each.message}" if place else str(each)), err=err)
        for name, value in (("in", each.element), ("fix", each.fix), ("nearest", ", ".join(each.nearest))):
            if value:
                typer.echo(f"    {name + ':':<9}{escape(value)}", err=err)


def load_given_model(path: str | Path, variables: Mapping[str, str]) -> Model:
    """Load a geometry file, and print its problems. Raises GeometryError, OSError."""
    from modelserver.formats import load_model

    model = load_model(path, variables=variables)
    print_problems(model.problems)
    return model


def format_count(count: int, one: str, several: str = "") -> str:
    """Return e.g. `1 body`, `3 bodies`."""
    return f"{count} {one if count == 1 else several or one + 's'}"


def describe_size(model: Model) -> str:
    frames = sum(len(body.frames) for body in model.bodies)
    bodies, constraints = len(model.bodies), len(model.constraints)
    counts = format_count(bodies, "body", "bodies"), format_count(frames, "frame")
    return ", ".join((*counts, format_count(constraints, "constraint")))


def to_json(value: Any) -> Any:
    """Return a value for JSON: an enumeration by name, flags as their number, null for a non-finite number.

    Named tuples and dataclasses are objects.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value):
        return {each.name: to_json(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: to_json(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    return value.name if isinstance(value, IntEnum) else value


def check_writable(path: str, replace: bool = True) -> None:
    """Raise the error of `open_atomic` for a file that cannot be written, before long work.

    An empty path and - (standard output) are no files.
    """
    if path in ("", "-"):
        return
    target = _find_target(path)
    if os.path.isfile(target) and not replace:
        raise _make_exists_error(path)
    if os.path.exists(target) and not os.path.isfile(target):
        return
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        raise ModelServerError(f"{escape(path)} cannot be written: folder {escape(folder)} is missing; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ModelServerError(f"{escape(path)} cannot be written: no write permission for folder {escape(folder)}")


def check_outputs(inputs: Sequence[Path], plot: str, output: str, replace: bool) -> None:
    """Raise typer.BadParameter or ModelServerError for outputs that cannot be written, before long work."""
    named = [each for each in (plot, output) if each and each != "-"]
    files = [*named, *map(str, inputs)]
    if len(set(map(os.path.realpath, files))) < len(files):
        raise typer.BadParameter("inputs, --plot and --output must be different files")
    for target in named:
        check_writable(target, replace)


def write_file(path: str, text: str, replace: bool) -> None:
    """Write a file atomically, see `open_atomic`; - is standard output, an empty path nothing."""
    if path == "-":
        typer.echo(text, nl=False)
    elif path:
        with open_atomic(path, replace) as stream:
            stream.write(text)


@contextlib.contextmanager
def open_atomic(path: str, replace: bool) -> Iterator[TextIO]:
    """Open a file for writing that replaces the old one when the block ends without an error.

    A device or a pipe is written directly. Raises ModelServerError where the file exists and `replace` is false,
    OSError where it cannot be written.
    """
    target = _find_target(path)
    if os.path.exists(target) and not os.path.isfile(target):
        with open(target, "w", encoding="utf-8", newline="\n") as stream:
            yield stream
        return
    if os.path.lexists(target):
        if not replace:
            raise _make_exists_error(path)
        mode = os.stat(target).st_mode & 0o777
    else:
        umask = os.umask(0)
        os.umask(umask)
        mode = 0o666 & ~umask
    try:
        handle, draft = tempfile.mkstemp(prefix=".", suffix=".part", dir=os.path.dirname(target))
    except OSError as error:
        # the name of the temporary file means nothing to the user
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
                # os.link fails where a file was created meanwhile, so that it is not lost
                os.link(draft, target)
            except FileExistsError:
                raise _make_exists_error(path) from None
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(draft)


def require_extra(extra: str, what: str) -> None:
    """Raise ModelServerError with the command that adds an extra unless it is installed; `what` needs a library."""
    if not is_installed(extra):
        raise ModelServerError(f"{what}, which is not installed: {make_install_command(extra)}")


@contextmanager
def write_beside(path: Path) -> Iterator[Path]:
    """Give the path of a draft beside a file, for a library that writes files by itself.

    The draft becomes the file at the end of the block; what is interrupted, also by a power failure, leaves no half
    file under that name.
    """
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        draft = Path(folder) / path.name
        yield draft
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.replace(path)


def _find_target(path: str) -> str:
    """Return what is written for a path. Raises ModelServerError for a directory, ForeignLinkError."""
    check_links(path)
    target = os.path.realpath(path)
    if os.path.isdir(target):
        raise ModelServerError(f"{escape(path)} is a directory; name a file in it")
    return target


def _make_exists_error(path: str) -> ModelServerError:
    return ModelServerError(f"{escape(path)} already exists; give --force to replace it, or another name")


_ASCII = str.maketrans({"→": ">", "├": "|", "└": "`", "─": "-", "│": "|", "·": ".", "⟲": "@"})


def format_table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Format rows as aligned columns; the columns in `numbers` are right-aligned."""
    lines = [[escape(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  "
        + "  ".join(
            cell.rjust(width) if number in numbers else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def replace_unencodable(text: str, encoding: str | None = None) -> str:
    """Replace box-drawing characters and arrows by ASCII if the terminal's encoding does not have them."""
    try:
        text.encode(encoding or sys.stdout.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        return text.translate(_ASCII).encode("ascii", "replace").decode()
    return text


class ProblemCollector:
    """Collect errors, and raise them together."""

    def __init__(self) -> None:
        self._errors: list[Problem] = []

    def add(self, what: str, why: str, fix: str = "") -> None:
        self._errors.append(Problem(Severity.ERROR, why, Location(what), fix))

    @contextmanager
    def collect(self, what: str) -> Iterator[None]:
        """Collect the errors that the block raises; those without a location are errors of `what`."""
        try:
            yield
        except (ConfigError, GeometryError) as error:
            self._errors += [each for each in error.problems if each.severity is Severity.ERROR]
        except ModelServerError as error:
            self.add(what, str(error))
        except OSError as error:
            self.add(str(error.filename or what), f"cannot be read: {error.strerror or error}")

    def raise_any(self) -> None:
        """Raise ConfigError with the errors, without duplicates, if there are any."""
        if self._errors:
            raise ConfigError(dict.fromkeys(self._errors))


def make_error(why: str, place: str | Location, fix: str) -> ConfigError:
    return ConfigError([Problem(Severity.ERROR, why, place if isinstance(place, Location) else Location(place), fix)])


def suggest_name(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return `did you mean NAME?` with the nearest known name, `otherwise` where none is near."""
    near = find_nearest_names(name, known)
    return f"did you mean {near[0]}?" if near else otherwise


def guess_time_unit(times: Iterable[int], begin: int, end: int) -> str:
    """Return the unit in which one of these times would lie between two utimes, empty for none."""
    units = (("seconds", 1_000_000.0), ("milliseconds", 1_000.0), ("nanoseconds", 0.001))
    times = list(times)
    return next((name for name, factor in units if any(begin <= each * factor <= end + 1e6 for each in times)), "")


def find_nearest_path(path: str | Path) -> str:
    """Return the existing path in the same folder with the most similar name; empty if there is none."""
    path = Path(path)
    with suppress(OSError):
        near = find_nearest_names(path.name, os.listdir(path.parent), 1)
        if near:
            return str(path.parent / near[0])
    return ""


def suggest_path(error: OSError) -> str:
    """Return `; did you mean PATH?` for a FileNotFoundError with a similar file, else an empty text."""
    near = find_nearest_path(error.filename) if isinstance(error, FileNotFoundError) and error.filename else ""
    return f"; did you mean {near}?" if near else ""


@contextmanager
def show_progress(label: str, total: float) -> Iterator[Callable[..., None]]:
    """Show a progress bar while the block runs; the block calls the given function with the part of `total` done.

    A second argument of the function is another label.

    Nothing is shown where stderr is no terminal.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done, text=label: bar.update(task, completed=done, description=text)


PROGRESS_STEPS: Final = 200
"""Of a bar while a log is read: half a character of a terminal."""


@contextmanager
def read_with_progress(label: str, path: Path) -> Iterator[tuple[LogFile, Generator[LogEvent, None, None]]]:
    """Open a log; give it with its events, and show how much of them is read.

    The progress bar, which redirects standard output, lasts from the first event until they are read, or closed.
    """
    from modelserver.wire.eventlog import LogFile

    def track() -> Generator[LogEvent, None, None]:
        with show_progress(f"{label} {path.name}", log.size) as show:
            shown = 0
            for event in log:
                if event.end >= shown:
                    shown = event.end + log.size // PROGRESS_STEPS
                    show(event.end)
                yield event

    with LogFile(path) as log, contextlib.closing(track()) as events:
        yield log, events


def open_screen() -> Live:
    """Return a display of the whole terminal, for a `with` block."""
    from rich.console import Console
    from rich.live import Live

    return Live(console=Console(highlight=False), screen=True, auto_refresh=False)


@contextmanager
def catch_signals() -> Iterator[Event]:
    """Within the block, SIGINT, SIGTERM and SIGHUP set the event and do nothing else.

    KeyboardInterrupt is no alternative: LCM's binding raises it, and Python raises it again for the same signal; and
    SIGTERM would not restore the terminal.
    """
    stop = Event()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
