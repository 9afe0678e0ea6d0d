"""Parts of `modelserver demo`, `up` and `emulate`: child processes, simulated drive, and emulated connections."""
