"""A start that is refused for its files, under a service manager: said once, then it waits for them to be mended."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import typer

from modelserver.errors import ConfigError, GeometryError, Location, ModelServerError, Problem, Severity
from modelserver.service.supervision.notify import Notifier
from modelserver.service.supervision.patience import Files
from mstools.terminal.output import print_problem


class Start:
    """The start of a service from its vehicle file."""

    def __init__(self, config: Path, notifier: Notifier):
        self._config, self._notifier = config, notifier
        self._files = Files(config)

    def needs(self, *files: str | Path) -> None:
        """Name further files that the start depends on, before they are read."""
        self._files.add(*(file for file in files if str(file)))

    @contextmanager
    def patient(self) -> Iterator[None]:
        """Have the block refused patiently where its files are wrong.

        Without a service manager its errors go their way. With one they are printed at once, and it is told the first;
        then the start ends as it would have, but not before a file has changed or the wait is over.
        """
        if not self._notifier.is_heard:
            yield
            return
        try:
            yield
        except (ConfigError, GeometryError) as error:
            self._refuse(error.problems, 1)
        except OSError as error:
            if error.filename is None or Path(error.filename) != self._config:
                raise
            why = f"the vehicle file cannot be read: {error.strerror}"
            self._refuse([_problem(why, self._config)], 1)
        except typer.BadParameter as error:
            self._refuse([_problem(error.message, self._config)], error.exit_code)
        except ModelServerError as error:
            self._refuse([_problem(str(error), self._config)], 1)

    def _refuse(self, problems: Iterable[Problem], code: int) -> NoReturn:
        problems = tuple(problems)
        for problem in problems:
            print_problem(problem, err=True)
        self._files.add(*(problem.file for problem in problems if problem.file))
        # it asks for more time too: the manager waits for READY only so long
        self._notifier.starting(status_of(problems))
        self._files.wait()
        raise typer.Exit(code)


def status_of(problems: Iterable[Problem]) -> str:
    """Return a refusal in a line for people: the first error, and how many more there are."""
    errors = [problem for problem in problems if problem.severity is Severity.ERROR]
    first = errors[0] if errors else None
    place = f"{first.file}:{first.line}: " if first is not None and first.line else ""
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    said = first.message if first is not None else "the vehicle file or its geometry is wrong"
    return f"refused, waits for the file to be mended: {place}{said}{more}"


def _problem(why: str, config: Path) -> Problem:
    return Problem(Severity.ERROR, why, Location(str(config)))
