"""Settings: the vehicle file, and the typed reader of YAML settings."""
