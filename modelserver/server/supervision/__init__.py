"""Supervision by systemd: notification, watchdog, restart."""
