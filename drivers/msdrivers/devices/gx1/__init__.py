"""The MicroStrain 3DM-GX1 inertial unit: its driver, and its hard-iron procedure."""
