"""`modelserver uninstall`: remove what `modelserver install` wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mstools.commands.install import DryRunOption, RootOption
from mstools.deployment.plan import plan_uninstall
from mstools.deployment.steps import check_root_user, execute_plan, get_command_path, read_facts
from mstools.terminal.options import option


def command(
    purge: Annotated[bool, option("--purge", "Also remove edited files and the state of the service.")] = False,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
) -> None:
    """Stop the service and its drivers, and remove what `modelserver install` wrote.

    A file that was edited since stays and is listed; so does the state of the service in /var/lib/modelserver.

    Example: modelserver uninstall --dry-run
    """
    root = root.resolve()
    if not dry_run:
        check_root_user(root, f"{get_command_path()} uninstall{' --purge' if purge else ''}")
    execute_plan(plan_uninstall(read_facts((), root), purge=purge), root, dry_run)
