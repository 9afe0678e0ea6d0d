"""The `modelserver` command, one module a subcommand."""
