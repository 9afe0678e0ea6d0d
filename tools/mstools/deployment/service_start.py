"""Start of a service under systemd: with wrong files it reports the error once, then waits until they change."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from modelserver.errors import ConfigError, GeometryError, Location, ModelServerError, Problem, Severity
from modelserver.server.supervision import FileWatcher, Notifier
from mstools.terminal.output import print_problems


class ServiceStart:
    """Start of a service from its vehicle file."""

    def __init__(self, config: Path, notifier: Notifier):
        self._config, self._notifier = config, notifier
        self._files = FileWatcher(config)

    def add_files(self, *files: str | Path) -> None:
        """Add further files that the start depends on, before they are read."""
        self._files.add(*(file for file in files if str(file)))

    @contextmanager
    def wait_on_error(self) -> Iterator[None]:
        """Run the block; where its files are wrong, report that and wait for a change before the process exits.

        Without a service manager errors propagate. With one they are printed at once, the first is its status, and the
        process exits with the same code, but only after a file has changed or the wait limit has passed.
        """
        if not self._notifier.is_active:
            yield
            return
        code = 1
        try:
            yield
            return
        except (ConfigError, GeometryError) as error:
            problems = error.problems
        except OSError as error:
            if error.filename is None or Path(error.filename) != self._config:
                raise
            problems = self._make_problem(f"the vehicle file cannot be read: {error.strerror}")
        except typer.BadParameter as error:
            problems, code = self._make_problem(error.message), error.exit_code
        except ModelServerError as error:
            problems = self._make_problem(str(error))
        print_problems(problems)
        self._files.add(*(problem.file for problem in problems if problem.file))
        # also extends the start timeout of systemd
        self._notifier.notify_starting(format_status(problems))
        self._files.wait_for_change()
        raise typer.Exit(code)

    def _make_problem(self, why: str) -> tuple[Problem, ...]:
        return (Problem(Severity.ERROR, why, Location(str(self._config))),)


def format_status(problems: Iterable[Problem]) -> str:
    """Return the problems in one line: the first error, and the number of others."""
    errors = [problem for problem in problems if problem.severity is Severity.ERROR]
    first = errors[0] if errors else None
    place = f"{first.file}:{first.line}: " if first is not None and first.line else ""
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    message = first.message if first is not None else "the vehicle file or its geometry is wrong"
    return f"start failed, waiting for the file to be fixed: {place}{message}{more}"
