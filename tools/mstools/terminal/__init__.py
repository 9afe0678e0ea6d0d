"""What commands share on the terminal: options, output, tables, progress."""
