"""The error-state filter: GPS, inertial unit, wheels and any further source, fused at their instants. Pure."""
