"""The MicroStrain 3DM-GX1 inertial unit: its driver."""
