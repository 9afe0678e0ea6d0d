"""Request handling: per-client queues, scheduling, signature verification, deferred replies."""
