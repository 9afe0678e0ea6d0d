"""The subcommands of `modelserver`."""
