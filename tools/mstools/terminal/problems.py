"""Problems of a command's input: collected to be reported all at once, and suggestions for missing files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from modelserver.errors import (
    ConfigError,
    GeometryError,
    Location,
    ModelServerError,
    Problem,
    Severity,
    find_nearest_names,
)


class ProblemCollector:
    """Collect errors, and raise them together."""

    def __init__(self) -> None:
        self._errors: list[Problem] = []

    def add(self, what: str, why: str, fix: str = "") -> None:
        """Add an error of a file or an option."""
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
    """Return the error of a file or an option with one problem."""
    return ConfigError([Problem(Severity.ERROR, why, place if isinstance(place, Location) else Location(place), fix)])


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
