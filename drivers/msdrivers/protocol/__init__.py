"""What devices say, byte by byte: parsers and writers without clock, socket, file, thread or log."""
