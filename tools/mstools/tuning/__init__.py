"""Search of noise settings by withheld fixes."""
