"""Parts of `modelserver demo`: processes, simulated drive, and local connections of the drivers."""
