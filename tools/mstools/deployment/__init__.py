"""Installation with systemd, and what the service needs of a machine."""
