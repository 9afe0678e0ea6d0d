"""The subcommands of `modelserver`, one module each, and what only they use."""
