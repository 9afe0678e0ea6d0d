"""The vehicle file: typed, strict. An unknown key is an error with the nearest known name."""
