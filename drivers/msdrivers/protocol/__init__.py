"""Wire protocols of the devices: parsers and encoders without clock, socket, file, thread or log."""
