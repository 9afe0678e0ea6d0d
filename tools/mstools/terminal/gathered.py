"""Problems of several things that are looked at one after another, to be told all at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from modelserver.errors import ConfigError, GeometryError, Location, ModelServerError, Problem, Severity


class Gathered:
    """Takes problems, and raises them together."""

    def __init__(self) -> None:
        self._errors: list[Problem] = []

    def add(self, what: str, why: str, fix: str = "") -> None:
        """Take an error of something: a file, an option."""
        self._errors.append(Problem(Severity.ERROR, why, Location(what), fix))

    @contextmanager
    def of(self, what: str) -> Iterator[None]:
        """Take the errors that the block raises; those without a place of their own are errors of `what`."""
        try:
            yield
        except (ConfigError, GeometryError) as error:
            self._errors += [each for each in error.problems if each.severity is Severity.ERROR]
        except ModelServerError as error:
            self.add(what, str(error))
        except OSError as error:
            self.add(str(error.filename or what), f"it cannot be read: {error.strerror or error}")

    def check(self) -> None:
        """Raise ConfigError where there are any, each once."""
        if self._errors:
            raise ConfigError(dict.fromkeys(self._errors))
