"""Device drivers: pure protocol parsers, emulators, and one runner for all. They publish raw sensor channels."""
