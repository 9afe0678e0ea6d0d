"""The files that `modelserver new` writes for a vehicle."""
