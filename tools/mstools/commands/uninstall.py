"""`modelserver uninstall`: what `install` did, taken back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstools.commands.install import DryRunOption, RootOption, show_or_do
from mstools.deployment.place import program
from mstools.deployment.plan import plan_uninstall
from mstools.deployment.steps import check_may, read_facts


def command(
    purge: Annotated[
        bool, typer.Option("--purge", help="Remove also what was edited since, and what the service has kept.")
    ] = False,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
) -> None:
    """Stop the service and its drivers, and remove what `modelserver install` wrote.

    A file that was edited since stays and is told; so does what the service has kept in /var/lib/modelserver.

    Example: modelserver uninstall --dry-run
    """
    root = root.resolve()
    if not dry_run:
        check_may(root, f"{program()} uninstall{' --purge' if purge else ''}")
    show_or_do(plan_uninstall(read_facts((), root), purge=purge), root, dry_run)
